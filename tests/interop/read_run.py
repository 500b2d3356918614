"""Reads a run directory with other people's readers: its tables with pyarrow, its events with TensorBoard's own loader.

usage: read_run.py RUN METRICS.json    (what `ccmarl list metric --format json` prints)
"""

import json
import math
import sys
from pathlib import Path

import pyarrow.parquet as parquet
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

run, listed = Path(sys.argv[1]), json.loads(Path(sys.argv[2]).read_text())
tables = {name: parquet.read_table(run / f"{name}.parquet") for name in ("metrics", "timings", "evaluation_standard")}
for name, table in tables.items():
    described = {m["name"] for m in listed if m["reference"].startswith(f"{name}.parquet")}
    missing = described - set(table.column_names)
    assert not missing, f"{name}.parquet lacks {missing}"
known = {m["name"] for m in listed}
undescribed = set(tables["metrics"].column_names + tables["timings"].column_names) - known
assert not undescribed, f"nobody says what {undescribed} mean"

events = EventAccumulator(str(run), size_guidance={"scalars": 0})
events.Reload()
metrics = tables["metrics"].to_pydict()
tags = set(events.Tags()["scalars"])
values = 0
for column, cells in metrics.items():
    if column in ("step", "update", "episode"):
        continue
    expected = [(step, cell) for step, cell in zip(metrics["step"], cells) if cell is not None]
    found = [(e.step, e.value) for e in events.Scalars(column)] if column in tags else []
    assert len(found) == len(expected), f"{column}: {len(expected)} in metrics.parquet, {len(found)} in the events"
    for (step, cell), (at, value) in zip(expected, found):
        assert step == at and math.isclose(cell, value, rel_tol=1e-6, abs_tol=1e-30), (column, step, cell, at, value)
    values += len(found)
print(f"ok tensorboard {run}: {values} values of {len(tags)} tags equal metrics.parquet; every column is described")
