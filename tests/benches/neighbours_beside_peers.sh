#!/bin/sh
# CPU seconds of our nearest-neighbour estimator and of Python's, in one run (column cpu_s).
# usage: neighbours_beside_peers.sh PYTHON PEERS OUT
#   PYTHON: an interpreter with scikit-learn ennemi infomeasure npeet-plus scipy; PEERS: the folder with ksg_bench.py;
#   OUT: where ccmarl.csv and peers.csv go
set -eu
python=$1 peers=$2 out=$3
cd "$(dirname "$0")/../.."
mkdir -p "$out"
"$python" "$peers/ksg_bench.py" | tee "$out/peers.csv"
CARGO_INCREMENTAL=1 cargo bench --bench neighbours | tee "$out/ccmarl.csv"
