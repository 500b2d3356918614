#!/usr/bin/env python3
"""Makes the files of this folder: one table in every form that other programs write, and predicates with what they keep.

    python3 -m venv VENV && VENV/bin/pip install numpy==2.4.6 pandas==3.1.1 pyarrow==26.0.1 mcap==1.6.0
    VENV/bin/python make.py

The values that the tests expect stand in tests/it/table_forms.rs, computed from the row number; SQLite says which rows a
predicate keeps (where.json).
"""

import datetime
import decimal
import json
import os
import random
import sqlite3

import numpy as np
import pyarrow as pa
import pyarrow.feather as feather
import pyarrow.ipc as ipc
import pyarrow.parquet as parquet
from mcap.writer import CompressionType, Writer

HERE = os.path.dirname(os.path.abspath(__file__))
N = 40


def at(name):
    return os.path.join(HERE, name)


def arrow_table():
    rows = range(N)
    day = datetime.date(2024, 1, 31)
    words = ["low", "high", "middle"]
    return pa.table({
        "i": pa.array([r * 7 % N for r in rows], pa.int64()),
        "f": pa.array([None if r == 3 else r * r / 8 for r in rows], pa.float64()),
        "u": pa.array([r % 5 for r in rows], pa.uint8()),
        "b": pa.array([r * 3 % 7 > 3 for r in rows], pa.bool_()),
        "s": pa.array([None if r == 5 else "w" + str(r * 5 % 4) for r in rows], pa.string()),
        "c": pa.array([words[r % 3] for r in rows]).dictionary_encode(),
        "v": pa.array([[r / 2, -r] for r in rows], pa.list_(pa.float32(), 2)),
        "d": pa.array([day + datetime.timedelta(days=r) for r in rows], pa.date32()),
        "t": pa.array([int(1706702400 * 10**9) + r for r in rows], pa.timestamp("ns", tz="UTC")),
        "m": pa.array([datetime.time(1, 0, r) for r in rows], pa.time64("us")),
        "p": pa.array([datetime.timedelta(milliseconds=250 * r) for r in rows], pa.duration("ms")),
    })


def arrow_files():
    table = arrow_table()
    with ipc.new_file(at("plain.arrow"), table.schema) as writer:
        writer.write_table(table, max_chunksize=16)
    with ipc.new_stream(at("stream.arrow"), table.schema) as writer:
        writer.write_table(table, max_chunksize=16)
    feather.write_feather(table, at("lz4.feather"), compression="lz4")
    feather.write_feather(table, at("zstd.feather"), compression="zstd")
    parquet.write_table(table, at("pyarrow.parquet"))
    frame = table.select(["i", "f", "b", "s", "c", "d", "t"]).to_pandas()
    frame.to_feather(at("pandas.feather"))
    frame.to_csv(at("pandas.csv"), index=False)


def odd_types():
    table = pa.table({
        "x": pa.array(range(20), pa.uint64()),
        "y": pa.array([r * r % 7 for r in range(20)], pa.int8()),
        "decimal": pa.array([decimal.Decimal(r) / 4 for r in range(20)], pa.decimal128(10, 2)),
        "half": pa.array([r / 2 for r in range(20)], pa.float16()),
        "pose": pa.array([{"x": r} for r in range(20)]),
        "nothing": pa.nulls(20),
    })
    feather.write_feather(table, at("odd.feather"))
    parquet.write_table(table, at("odd.parquet"))


def arrays():
    rows = np.arange(N)
    matrix = np.stack([rows * 7 % N, rows * rows / 8, -rows], axis=1)
    np.save(at("c-order.npy"), matrix)
    np.save(at("fortran.npy"), np.asfortranarray(matrix))
    np.save(at("big-endian.npy"), matrix.astype(">f4"))
    np.save(at("half.npy"), (matrix[:, 2] / 2).astype("<f2"))
    np.save(at("integers.npy"), (matrix[:, :2].astype("<i2")))
    np.save(at("unsigned.npy"), np.array([1, 2**63 + 2**20, 5], dtype="<u8"))
    np.save(at("truths.npy"), rows % 3 == 0)
    np.save(at("days.npy"), np.datetime64("2024-01-31", "D") + rows)
    fields = np.zeros(N, dtype=[("id", "<i4"), ("pose", [("x", "<f8"), ("y", ">f4")]), ("v", "<f4", (2,)), ("name", "U3"),
                                ("code", "S2")])
    fields["id"], fields["pose"]["x"], fields["pose"]["y"] = rows, rows / 4, rows * 2
    fields["v"], fields["name"] = np.stack([rows, -rows], axis=1), [["äb", "c"][r % 2] for r in rows]
    fields["code"] = [[b"xy", b"z"][r % 2] for r in rows]
    np.save(at("fields.npy"), fields)


def messages():
    with open(at("json.mcap"), "wb") as stream:
        writer = Writer(stream, chunk_size=600, compression=CompressionType.ZSTD)
        writer.start()
        schema = writer.register_schema("any", "jsonschema", b"{}")
        imu, state, odd, cdr = (writer.register_channel(topic, encoding, schema) for topic, encoding in
                                [("/imu", "json"), ("/state", "json"), ("/odd", "json"), ("/camera", "cdr")])

        def add(channel, time, value):
            writer.add_message(channel, log_time=time, publish_time=time, data=json.dumps(value).encode())

        for r in range(N):
            time = 10**18 + r * 10**7
            add(imu, time, {"linear_acceleration": {"x": r / 2, "y": -r}, "frame": ["a", "b"][r % 2], "v": [r, r * r]})
            if r % 2 == 0:
                add(state, time, {"on": r % 3 == 0, "level": None if r == 4 else r * 1.5})
            add(odd, time + 1, {"level": r if r % 2 else str(r)})
            add(cdr, time, {})
        writer.finish()


def predicate(rng, depth=0):
    kind = rng.randrange(8 if depth < 3 else 6)
    number = lambda: rng.choice(["a", "b", "a + b", "a * 2 - 3", "-b", "a % 3", str(rng.randrange(-4, 9)), "2.5", "1e1"])
    text = lambda: rng.choice(["s", "'m'", "'ab'", "s"])
    compare = lambda: rng.choice(["=", "<>", "<", "<=", ">", ">=", "!="])
    no = lambda: rng.choice(["", "NOT "])
    if kind == 0:
        return f"{number()} {compare()} {number()}"
    if kind == 1:
        return f"{text()} {compare()} {text()}"
    if kind == 2:
        return f"{number()} {no()}BETWEEN {number()} AND {number()}"
    if kind == 3:
        return f"a {no()}IN ({', '.join(rng.choice(['0', '1', '2', '5', 'NULL', 'b']) for _ in range(3))})"
    if kind == 4:
        return f"{rng.choice(['a', 'b', 's', 'a + b'])} IS {no()}NULL"
    if kind == 5:
        return f"s {no()}LIKE '{rng.choice(['a%', '%b', '_', '%a%b%', 'Ab', '', '%', '_b%'])}'"
    inner = f"({predicate(rng, depth + 1)} {rng.choice(['AND', 'OR'])} {predicate(rng, depth + 1)})"
    return inner if kind == 6 else f"NOT {inner}"


def predicates():
    rng = random.Random(1)
    pick = lambda choices: rng.choice(choices)
    rows = [(r, pick([None, -3, 0, 1, 2, 5, 8]), pick([None, -1.5, 0.0, 2.5, 2.0, 7.25]),
             pick([None, "", "a", "ab", "aab", "Ab", "m", "b"])) for r in range(60)]
    base = sqlite3.connect(":memory:")
    base.execute("PRAGMA case_sensitive_like = ON")
    base.execute("CREATE TABLE t (id INTEGER, a INTEGER, b REAL, s TEXT)")
    base.executemany("INSERT INTO t VALUES (?, ?, ?, ?)", rows)
    cases = []
    while len(cases) < 300:
        condition = predicate(rng)
        kept = [r for (r,) in base.execute(f"SELECT id FROM t WHERE {condition} ORDER BY id")]
        cases.append([condition, kept])
    with open(at("where.json"), "w", encoding="utf-8") as out:
        out.write('{"sqlite": ' + json.dumps(sqlite3.sqlite_version) + ',\n "rows": [\n  ')
        out.write(",\n  ".join(json.dumps(row) for row in rows) + '],\n "cases": [\n  ')
        out.write(",\n  ".join(json.dumps(case) for case in cases) + "]}\n")


arrow_files()
odd_types()
arrays()
messages()
predicates()
