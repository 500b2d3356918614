#!/bin/sh
# Reads fresh and golden stores with other people's readers (requirements.txt) and compares all values with
# `ccmarl inspect`. Needs python3 with venv and network access to PyPI; exit code 77 where these are missing.
# usage: tests/interop/run.sh [WORK_DIR]
set -eu
cd "$(dirname "$0")/../.."
work=${1:-target/interop}
mkdir -p "$work"
work=$(realpath "$work")
bin="$work/venv/bin"
if ! { [ -x "$bin/pip" ] || python3 -m venv "$work/venv"; } >/dev/null 2>&1; then
    echo "interop: python3 with venv is missing" >&2
    exit 77
fi
if ! "$bin/pip" install --quiet --disable-pip-version-check --timeout 20 --retries 1 -r tests/interop/requirements.txt; then
    echo "interop: the readers could not be installed from PyPI" >&2
    exit 77
fi
# nothing is asked of, or told to, anybody's server
export XDG_CONFIG_HOME="$work/xdg" XDG_CACHE_HOME="$work/xdg" XDG_DATA_HOME="$work/xdg" HF_HOME="$work/xdg"
export HF_HUB_OFFLINE=1 HF_DATASETS_OFFLINE=1 NO_COLOR=1
"$bin/rerun" analytics disable >/dev/null 2>&1

CCMARL_STORES="$work" cargo test --release --quiet --test it -- --ignored --exact stores::make_interop_stores >/dev/null
mkdir -p "$work/tag"
ccmarl() { cargo run --release --quiet -- "$@"; }
for form in store store.parquet store.mcap; do
    ccmarl record --scenario simple_tag --link markov:medium --episodes 200 --seed 3 --force --out "$work/tag/$form" >/dev/null 2>&1
done
for set in "$work" "$work/tag" datasets/golden/v1; do
    for form in store store.parquet store.mcap; do
        ccmarl inspect "$set/$form" --format json > "$work/inspect.json"
        "$bin/python" tests/interop/read_stores.py "$work/inspect.json" \
            "$set/store" "$set/store.parquet" "$set/store.mcap"
    done
done

# MCAP through Parquet and back: the same messages, by pymcap-cli's digest, and doctor has nothing to say
ccmarl convert "$work/tag/store" "$work/tag/back.mcap" --force >/dev/null 2>&1
for file in store back; do
    "$bin/pymcap-cli" doctor "$work/tag/$file.mcap" >/dev/null
    "$bin/pymcap-cli" hash "$work/tag/$file.mcap" > "$work/$file.hash" 2>/dev/null
done
cmp "$work/store.hash" "$work/back.hash"
echo "ok pymcap-cli $work/tag/store.mcap: doctor, hash equal after Parquet and back: $(cat "$work/store.hash")"

"$bin/rerun" mcap check "$work/tag/store.mcap" >/dev/null 2>&1
rm -f "$work/tag/store.rrd"
"$bin/rerun" mcap convert "$work/tag/store.mcap" -o "$work/tag/store.rrd" >/dev/null 2>&1
"$bin/rerun" rrd verify "$work/tag/store.rrd" >/dev/null 2>&1
"$bin/python" tests/interop/read_scene.py "$work/tag/store.mcap" "$work/tag/store.rrd"

# a run: its tables described, its events in TensorBoard's own reader, its team in PyTorch where that is installed (a large
# package: here, or as another python's in CCMARL_TORCH_PYTHON, with pyarrow and safetensors beside it)
ccmarl train --scenario simple_spread --algorithm cc-maddpg --steps 30000 --evaluate standard --evaluate-every 10000 --force \
    --out "$work/run" >/dev/null 2>&1
ccmarl list metric --format json > "$work/metrics.json"
"$bin/python" tests/interop/read_run.py "$work/run" "$work/metrics.json"
ccmarl record --scenario simple_spread --policy "run:$work/run" --link dropout:0.3 --episodes 60 --force --out "$work/acted" >/dev/null 2>&1
torch=${CCMARL_TORCH_PYTHON:-$bin/python}
if "$torch" -c "import torch, safetensors, pyarrow" >/dev/null 2>&1; then
    "$torch" tests/interop/act_in_pytorch.py "$work/run/checkpoint/actors.safetensors" "$work/acted"
    # and a team whose messages are an encoder's
    printf 'algorithm = "cc-maddpg"\nsteps = 30000\nscenario = { name = "simple_spread" }\n[maddpg]\nmessages = "encoder"\n' > "$work/encoder.toml"
    ccmarl train --config "$work/encoder.toml" --force --out "$work/encoded" >/dev/null 2>&1
    ccmarl record --scenario simple_spread --policy "run:$work/encoded" --link dropout:0.3 --episodes 60 --force --out "$work/sent" >/dev/null 2>&1
    "$torch" tests/interop/act_in_pytorch.py "$work/encoded/checkpoint/actors.safetensors" "$work/sent"
else
    echo "skipped: no PyTorch with safetensors and pyarrow (CCMARL_TORCH_PYTHON names a python that has them)"
fi

# what mpe2 does with a seed that no golden store has, written by Python, played again step by step
rm -rf "$work/mpe2"
PYTHONDONTWRITEBYTECODE=1 "$bin/python" datasets/golden/mpe2/record.py "$work/mpe2" --seed 7 >/dev/null
for store in "$work"/mpe2/*; do
    ccmarl verify "$store" --resimulate >/dev/null
done
echo "ok mpe2 1.1.1: $(ls "$work/mpe2" | wc -l) stores written by Python play again within 1e-9 and 1e-6"
