#!/bin/sh
# CPU milliseconds of one update of ours, of a jitted JAX loop and of PyTorch (tuned and idiomatic), in one run.
# usage: train_beside_peers.sh PYTHON PEERS OUT
#   PYTHON: an interpreter with jax jaxmarl torch mpe2 pettingzoo numpy; PEERS: the folder with jax_maddpg_bench.py and
#   torch_maddpg_bench.py; OUT: where train.csv, jax.txt, torch.csv and beside_peers.md go
# BENCH: a built benchmark to run instead of `cargo bench --bench train`
set -eu
python=$1 peers=$2 out=$3
cd "$(dirname "$0")/../.."
mkdir -p "$out"
out=$(cd "$out" && pwd)
ours() {
    if [ -n "${BENCH:-}" ]; then "$BENCH" "$out"; else CARGO_INCREMENTAL=1 cargo bench --bench train -- "$out"; fi
}
OMP_NUM_THREADS=1 "$python" "$peers/jax_maddpg_bench.py" | tee "$out/jax.txt"
OMP_NUM_THREADS=1 "$python" "$peers/torch_maddpg_bench.py" "$out/torch.csv" --threads 1 --only update --reps 100
ours
"$python" - "$out" <<'TABLE' | tee "$out/beside_peers.md"
import csv, pathlib, re, sys

out = pathlib.Path(sys.argv[1])
lines = [line for line in (out / "train.csv").read_text().splitlines() if not line.startswith("#")]
ours = {row["case"]: float(row["ms_per_update"]) for row in csv.DictReader(lines)}
jax = {}
for line in (out / "jax.txt").read_text().splitlines():
    found = re.match(r"jax comm=(\d) seeds=1:.*update ms/seed wall=\S+ cpu=(\S+?);", line)
    if found:
        jax[found[1]] = float(found[2])
torch = {}
for row in csv.DictReader((out / "torch.csv").open()):
    if row["bench"] == "torch_update":
        torch[row["style"], row["comm"], row["mode"]] = float(row["ms_cpu_min"])
print("| one update, CPU ms | ours | JAX jit | PyTorch tuned | PyTorch idiomatic | best peer / ours |")
print("|---|---|---|---|---|---|")
for case, comm, mode in [("no messages", "0", "joint"), ("messages", "1", "joint"), ("no messages per-agent", "0", "per"),
                         ("messages per-agent", "1", "per"), ("cc-maddpg 16 negatives", None, None),
                         ("cc-maddpg all negatives", None, None)]:
    theirs = [jax.get(comm) if mode == "joint" else None, torch.get(("tuned", comm, mode)), torch.get(("idiom", comm, mode))]
    best = min((t for t in theirs if t), default=None)
    cells = ["" if t is None else f"{t:.2f}" for t in theirs]
    print("|", " | ".join([case, f"{ours[case]:.2f}", *cells, f"{best / ours[case]:.1f}" if best else ""]), "|")
TABLE
