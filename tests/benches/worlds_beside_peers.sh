#!/bin/sh
# Steps per second of our worlds and of Python's mpe2 and jaxmarl, in one run. CPU time counts (cpu_sps, steps_per_cpu_s).
# usage: worlds_beside_peers.sh PYTHON PEERS OUT
#   PYTHON: an interpreter with mpe2 pettingzoo numpy jax jaxmarl; PEERS: the folder with mpe2_step_bench.py and
#   jaxmarl_step_bench.py; OUT: where worlds.csv, cost.svg and peers.txt go
set -eu
python=$1 peers=$2 out=$3
cd "$(dirname "$0")/../.."
mkdir -p "$out"
{
    "$python" "$peers/mpe2_step_bench.py" 5000
    "$python" "$peers/jaxmarl_step_bench.py" 1
} | tee "$out/peers.txt"
CARGO_INCREMENTAL=1 cargo bench --bench worlds -- "$(cd "$out" && pwd)"
