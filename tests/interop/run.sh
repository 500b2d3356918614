#!/bin/sh
# Reads fresh stores with Python's pyarrow, polars, duckdb and mcap and compares the sums with `ccmarl inspect`.
# Needs python3 with venv and network access to PyPI. usage: tests/interop/run.sh [WORK_DIR]
set -eu
cd "$(dirname "$0")/../.."
work=${1:-target/interop}
mkdir -p "$work"
[ -x "$work/venv/bin/python" ] || python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check -r tests/interop/requirements.txt
CCMARL_STORES=$(realpath "$work") cargo test --release --quiet --test it -- --ignored --exact stores::make_interop_stores
for set in "$work" datasets/golden/v1; do
    for form in store store.parquet store.mcap; do
        cargo run --release --quiet -- inspect "$set/$form" --format json > "$work/inspect.json"
        "$work/venv/bin/python" tests/interop/read_stores.py "$work/inspect.json" \
            "$set/store" "$set/store.parquet" "$set/store.mcap"
    done
done
