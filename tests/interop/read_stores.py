"""Reads rollout stores with pyarrow, polars, duckdb and mcap, and compares the sum of every column with what
`ccmarl inspect --format json` prints.

usage: read_stores.py INSPECT_JSON STORE...   (STORE: a directory, a .parquet or a .mcap file of the same rollouts)

Prints one `ok` line per reader and store; exit 1 on the first difference.
"""

import json
import math
import sys
from pathlib import Path


def parquet_files(store: Path) -> list[str]:
    return [str(p) for p in sorted(store.glob("part-*.parquet"))] if store.is_dir() else [str(store)]


def with_pyarrow(store: Path) -> dict[str, float]:
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.parquet as pq

    table = pa.concat_tables([pq.read_table(f) for f in parquet_files(store)])
    sums = {}
    for name in table.column_names:
        column = table[name].combine_chunks()
        kind = column.type
        if pa.types.is_fixed_size_list(kind):
            column = column.drop_null().flatten()
        if pa.types.is_float32(column.type):
            column = column.cast(pa.float64())
        sums[name] = pc.sum(column).as_py() or 0
    return sums


def with_polars(store: Path) -> dict[str, float]:
    import polars as pl

    frame = pl.read_parquet(parquet_files(store))
    sums = {}
    for name, kind in frame.schema.items():
        column = frame[name].drop_nulls()
        if isinstance(kind, pl.Array):
            column = column.explode()
        sums[name] = column.cast(pl.Float64).sum()
    return sums


def with_duckdb(store: Path) -> dict[str, float]:
    import duckdb

    base = duckdb.connect()
    files = parquet_files(store)
    columns = base.execute("describe select * from read_parquet(?)", [files]).fetchall()
    sums = {}
    for name, kind, *_ in columns:
        quoted = '"' + name.replace('"', '""') + '"'
        if kind.endswith("[]") or "[" in kind:
            inner = f"select unnest({quoted}) as v from read_parquet(?)"
        else:
            inner = f"select {quoted} as v from read_parquet(?)"
        value = base.execute(f"select sum(v::double) from ({inner})", [files]).fetchone()[0]
        sums[name] = value or 0
    return sums


def with_mcap(store: Path) -> dict[str, float]:
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
    from mcap.reader import make_reader

    classes = {}
    sums: dict[str, float] = {"link": 0.0, "state": 0.0, "reward": 0.0, "episode": 0.0, "step": 0.0}
    rows, ends, steps, last_time = 0, 0, 0, -1

    def add(name: str, values) -> None:
        sums[name] = sums.get(name, 0.0) + math.fsum(values)

    with store.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            if schema.id not in classes:
                assert schema.encoding == "protobuf" and channel.message_encoding == "protobuf"
                pool = descriptor_pool.DescriptorPool()
                for one in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                    pool.Add(one)
                classes[schema.id] = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
            data = classes[schema.id].FromString(message.data)
            assert message.log_time >= last_time, "log time goes back"
            last_time = message.log_time
            if channel.topic == "/rollout/episode":
                ends, steps = ends + 1, steps + data.steps
                continue
            assert channel.topic == "/rollout/step" and message.sequence == data.step
            rows += 1
            add("episode", [data.episode])
            add("step", [data.step])
            add("state", data.state)
            add("link", data.link)
            if data.HasField("reward"):
                add("reward", [data.reward])
            for agent in data.agents:
                for kind in ("observation", "message", "action"):
                    values = getattr(agent, kind)
                    if values:
                        add(f"{kind}.{agent.name}", values)
                if agent.HasField("reward"):
                    add(f"reward.{agent.name}", [agent.reward])
    assert rows == steps + ends, f"{rows} rows for {ends} episodes of {steps} steps"
    return sums


def compare(reader: str, store: Path, expected: dict[str, float], found: dict[str, float]) -> None:
    for column, value in expected.items():
        if column not in found:
            sys.exit(f"{reader}: {store}: column {column} is missing")
        if not math.isclose(value, float(found[column]), rel_tol=1e-9, abs_tol=1e-6):
            sys.exit(f"{reader}: {store}: sum of {column}: inspect says {value}, found {found[column]}")
    print(f"ok {reader} {store}: {len(expected)} columns")


def main() -> None:
    expected = json.loads(Path(sys.argv[1]).read_text())["sums"]
    for store in map(Path, sys.argv[2:]):
        readers = [with_mcap] if store.suffix == ".mcap" else [with_pyarrow, with_polars, with_duckdb]
        for reader in readers:
            compare(reader.__name__.removeprefix("with_"), store, expected, reader(store))


if __name__ == "__main__":
    main()
