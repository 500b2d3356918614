#!/usr/bin/env bash
# Trains the four rows of the paper's table on simple_spread for 4e6 steps per seed, two runs at a time, tests each on
# eight channels, and writes the report beside this script.
# usage: reports/training/make.sh WORK_DIR [SEED...]     (default: seed 1; CCMARL names the program)
set -euo pipefail
cd "$(dirname "$0")/../.."
work=${1:?usage: reports/training/make.sh WORK_DIR [SEED...]}
shift
[ $# -gt 0 ] || set -- 1
ccmarl=${CCMARL:-$(pwd)/target/release/ccmarl}
out=reports/training
mkdir -p "$work"

train() { # algorithm seed
    local run="$work/$1-$2"
    /usr/bin/env bash -c 'time "$@" >/dev/null 2>&1' time \
        "$ccmarl" train --scenario simple_spread --algorithm "$1" --steps 4000000 --seed "$2" --out "$run" --force \
        2> "$work/$1-$2.time"
    "$ccmarl" evaluate "$run" --suite paper --episodes 100 > /dev/null
}
export -f train
export ccmarl work

for seed in "$@"; do
    for algorithm in maddpg fc-maddpg dropout-maddpg-0.2 cc-maddpg; do echo "$algorithm $seed"; done
done | xargs -P 2 -L 1 bash -euo pipefail -c 'train "$@"' train

runs=()
for seed in "$@"; do
    for algorithm in maddpg fc-maddpg dropout-maddpg-0.2 cc-maddpg; do
        name="$algorithm-$seed"
        mkdir -p "$out/runs/$name"
        cp "$work/$name"/{config.toml,metrics.parquet,evaluation.parquet} "$out/runs/$name/"
        runs+=("$out/runs/$name")
    done
done
"$ccmarl" report "${runs[@]}" --out "$out/report" --title "simple_spread, three agents, 4e6 steps" --force
grep -H user "$work"/*.time
