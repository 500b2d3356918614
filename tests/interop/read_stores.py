"""Reads rollout stores with other people's readers and compares every value with what `ccmarl inspect` says: the sum
of each column, and the content digest, which is recomputed here from the values that each reader gives.

usage: read_stores.py INSPECT_JSON STORE...   (STORE: a directory, a .parquet or a .mcap file of the same rollouts)

Prints one `ok` line per reader and store; exit 1 on the first difference.
"""

import hashlib
import json
import math
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa


def parquet_files(store: Path) -> list[str]:
    return [str(p) for p in sorted(store.glob("part-*.parquet"))] if store.is_dir() else [str(store)]


def rows_of(column) -> np.ndarray:
    """The rows of an Arrow column that are not null, [rows, width]."""
    column = column.drop_null()
    if isinstance(column, pa.ChunkedArray):
        column = column.combine_chunks()
    rows = len(column)
    if pa.types.is_nested(column.type):
        column = column.flatten()
    values = column.to_numpy(zero_copy_only=False)
    return values.reshape(rows, -1)


def with_pyarrow(store: Path) -> dict[str, np.ndarray]:
    import pyarrow.parquet as pq

    table = pa.concat_tables([pq.read_table(f) for f in parquet_files(store)])
    return {name: rows_of(table[name]) for name in table.column_names}


def with_polars(store: Path) -> dict[str, np.ndarray]:
    import polars as pl

    frame = pl.read_parquet(parquet_files(store))
    columns = {name: frame[name].drop_nulls() for name in frame.columns}
    return {name: column.to_numpy().reshape(len(column), -1) for name, column in columns.items()}


def with_duckdb(store: Path) -> dict[str, np.ndarray]:
    import duckdb

    query = "select * from read_parquet(?) order by episode, step"
    table = duckdb.sql(query, params=[parquet_files(store)]).to_arrow_table()
    return {name: rows_of(table[name]) for name in table.column_names}


def with_pandas(store: Path) -> dict[str, np.ndarray]:
    import pandas as pd

    frame = pd.concat([pd.read_parquet(f) for f in parquet_files(store)])
    columns = {name: frame[name].dropna() for name in frame.columns}
    return {name: np.stack(list(c)).reshape(len(c), -1) for name, c in columns.items()}


def with_datasets(store: Path) -> dict[str, np.ndarray]:
    import datasets

    datasets.disable_progress_bars()
    files = [str(Path(f).absolute()) for f in parquet_files(store)]
    table = datasets.Dataset.from_parquet(files, cache_dir="/nonexistent", keep_in_memory=True).data.table
    return {name: rows_of(table[name]) for name in table.column_names}


def with_mcap(store: Path) -> dict[str, np.ndarray]:
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
    from mcap.reader import make_reader

    classes = {}
    lists: dict[str, list] = {}
    rows, ends, steps, last_time = 0, 0, 0, -1

    def add(name: str, values) -> None:
        lists.setdefault(name, []).append(values)

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
            if channel.topic != "/rollout/step":
                continue
            assert message.sequence == data.step
            rows += 1
            add("episode", [data.episode])
            add("step", [data.step])
            add("is_terminal", [data.is_terminal])
            add("state", np.array(data.state))
            add("link", np.array(data.link, dtype=bool))
            if data.HasField("reward"):
                add("reward", np.float32([data.reward]))
            for agent in data.agents:
                for kind in ("observation", "message", "action"):
                    if values := getattr(agent, kind):
                        add(f"{kind}.{agent.name}", np.array(values, dtype=np.float32))
                if agent.HasField("reward"):
                    add(f"reward.{agent.name}", np.float32([agent.reward]))
    assert rows == steps + ends, f"{rows} rows for {ends} episodes of {steps} steps"
    return {name: np.stack(values) for name, values in lists.items()}


def content(columns: dict[str, np.ndarray], agents: list[dict]) -> str:
    """The digest over the content hashes of all episodes; Episode::content_hash says over what."""
    names = [agent["name"] for agent in agents]
    kinds = ["state", *(f"observation.{n}" for n in names), *(f"message.{n}" for n in names), "link"]
    acted = [*(f"action.{n}" for n in names), "reward", *(f"reward.{n}" for n in names)]
    last = np.append(np.flatnonzero(columns["step"][1:, 0] == 0), len(columns["step"]) - 1)
    total = hashlib.sha256()
    row = 0
    for episode, end in enumerate(last + 1):
        steps = end - row - 1
        terminal = bool(columns["is_terminal"][end - 1, 0])
        one = hashlib.sha256(b"ccmarl episode v1" + int(steps).to_bytes(8, "little") + bytes([terminal]))
        for names, first, count in ((kinds, row, steps + 1), (acted, row - episode, steps)):
            for name in names:
                if name in columns:
                    kind = {"state": "<f8", "link": "u1"}.get(name, "<f4")
                    one.update(columns[name][first : first + count].astype(kind, copy=False).tobytes())
        total.update(one.digest())
        row = end
    return total.hexdigest()


def compare(reader: str, store: Path, inspected: dict, columns: dict[str, np.ndarray]) -> None:
    for column, value in inspected["sums"].items():
        found = columns[column].sum(dtype=np.float64) if column in columns else 0.0
        if not math.isclose(value, float(found), rel_tol=1e-9, abs_tol=1e-6):
            sys.exit(f"{reader}: {store}: sum of {column}: inspect says {value}, found {found}")
    digest = content(columns, inspected["agents"])
    if digest != inspected["content"]:
        sys.exit(f"{reader}: {store}: content: inspect says {inspected['content']}, found {digest}")
    print(f"ok {reader} {store}: {len(inspected['sums'])} columns, content {digest[:16]}…")


def main() -> None:
    inspected = json.loads(Path(sys.argv[1]).read_text())
    for store in map(Path, sys.argv[2:]):
        parquet = [with_pyarrow, with_polars, with_duckdb, with_pandas, with_datasets]
        for reader in [with_mcap] if store.suffix == ".mcap" else parquet:
            compare(reader.__name__.removeprefix("with_"), store, inspected, reader(store))


if __name__ == "__main__":
    main()
