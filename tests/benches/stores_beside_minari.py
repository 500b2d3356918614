"""Writing and reading the same rollouts with ccmarl and with Minari, in one run: CPU seconds, wall seconds, bytes, ratios.

usage: stores_beside_minari.py CCMARL WORK_DIR [--episodes N] [--train STEPS] [--bench STORES]
(needs minari[hdf5,create], gymnasium, numpy, pillow, pyarrow; STORES is the program of `cargo bench --bench stores`)

ccmarl trains a policy for STEPS steps (0: none, the policy is random), records N episodes of it (worlds included) and counts
all columns of every episode (`inspect`, every digest checked); STORES records and reads the same into replay memory, beside
the other forms. Minari gets the same observations, messages, actions and team rewards as arrays in memory, writes them, and
reads every episode back.
"""

import argparse
import os
import resource
import shutil
import subprocess
import time
import warnings
from pathlib import Path

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("ccmarl")
parser.add_argument("work", type=Path)
parser.add_argument("--episodes", type=int, default=16000)
parser.add_argument("--train", type=int, default=400_000, metavar="STEPS")
parser.add_argument("--bench", metavar="STORES")
args = parser.parse_args()
args.work.mkdir(parents=True, exist_ok=True)
os.environ["MINARI_DATASETS_PATH"] = str(args.work / "minari")

warnings.filterwarnings("ignore")  # Minari's, about the data set's description
import gymnasium as gym
import minari
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from minari.data_collector import EpisodeBuffer


def size(path: Path) -> int:
    return sum(p.stat().st_size for p in path.rglob("*") if p.is_file())


best = {}


def timed(what, steps, work, who):
    before, start = resource.getrusage(who), time.perf_counter()
    result = work()
    after, wall = resource.getrusage(who), time.perf_counter() - start
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(f"{what},{steps / wall:.0f},{steps / cpu:.0f},{wall:.2f},{cpu:.2f}", flush=True)
    best[what] = min(best.get(what, (1e9, 1e9)), (wall, cpu))
    return result


def run(*words):
    subprocess.run([args.ccmarl, *words], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


print("what,steps_per_wall_s,steps_per_cpu_s,wall_s,cpu_s")
store, steps = args.work / "store", args.episodes * 25
world, policy = ["--scenario", "simple_spread", "--agents", "3"], "random"
if args.train:
    trained = args.work / "run"
    policy = f"run:{trained}"
    run("train", *world, "--algorithm", "fc-maddpg", "--steps", str(args.train), "--out", str(trained), "--force")
record = ["record", *world, "--policy", policy, "--episodes", str(args.episodes), "--seed", "1"]
for _ in range(3):
    timed("ccmarl record", steps, lambda: run(*record, "--out", str(store), "--force"), resource.RUSAGE_CHILDREN)
for _ in range(3):
    timed("ccmarl inspect", steps, lambda: run("inspect", str(store)), resource.RUSAGE_CHILDREN)

columns = [f"{kind}.agent_{i}" for kind in ("observation", "message", "action") for i in range(3)] + ["reward"]
tables = [pq.read_table(part, columns=columns) for part in sorted(store.glob("part-*.parquet"))]


def column(name, width):
    parts = [t[name].combine_chunks() for t in tables]
    flat = np.concatenate([np.asarray(p.flatten() if width > 1 else p.drop_null()) for p in parts])
    return flat.reshape(args.episodes, -1, width) if width > 1 else flat.reshape(args.episodes, -1)


observed = [column(c, 18) for c in columns[:6]]
acted = [column(c, 2) for c in columns[6:9]]
reward = column("reward", 1)
box = lambda width: gym.spaces.Box(-np.inf, np.inf, (width,), np.float32)
names = columns[:6]


def write():
    buffers = [
        EpisodeBuffer(
            id=e,
            observations={n: o[e] for n, o in zip(names, observed)},
            actions={f"a{i}": a[e] for i, a in enumerate(acted)},
            rewards=list(reward[e]),
            terminations=[False] * 25,
            truncations=[False] * 24 + [True],
        )
        for e in range(args.episodes)
    ]
    minari.create_dataset_from_buffers(
        "ccmarl/spread-v0",
        buffers,
        observation_space=gym.spaces.Dict({n: box(18) for n in names}),
        action_space=gym.spaces.Dict({f"a{i}": box(2) for i in range(3)}),
    )


def read():
    total = 0.0
    for episode in minari.load_dataset("ccmarl/spread-v0"):
        total += float(episode.observations[names[0]].sum()) + float(np.sum(episode.rewards))
    return total


shutil.rmtree(args.work / "minari", ignore_errors=True)
timed("minari write", steps, write, resource.RUSAGE_SELF)
total = timed("minari read", steps, read, resource.RUSAGE_SELF)
expected = float(observed[0].sum(dtype=np.float64)) + float(reward.sum(dtype=np.float64))
assert abs(total - expected) < 1e-3 * abs(expected), "minari gave other values back"
# what the columns take as 32-bit floats: state, observations, messages, actions and all rewards; keys and links not counted
schema = pq.read_schema(next(store.glob("part-*.parquet")))
floats = sum(
    (field.type.list_size if pa.types.is_fixed_size_list(field.type) else 1)
    for field in schema
    if field.name.split(".")[0] in ("state", "observation", "message", "action", "reward")
)
raw, ours, theirs = 4 * floats * args.episodes * 26, size(store), size(args.work / "minari")
print(f"bytes: ccmarl {ours} (state, links and rewards per agent included), {ours / raw:.3f} of raw f32; minari {theirs}")
for verb, mine in (("write", "ccmarl record"), ("read", "ccmarl inspect")):
    (wall, cpu), (my_wall, my_cpu) = best[f"minari {verb}"], best[mine]
    print(f"{mine} beside minari {verb}: {wall / my_wall:.1f} times the speed, {cpu / my_cpu:.1f} times less processor time")
if args.bench:
    where = ["--episodes", str(args.episodes), "--policy", policy, "--repeats", "3"]
    print(subprocess.run([args.bench, *where], check=True, capture_output=True, text=True).stdout, end="")
