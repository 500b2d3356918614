"""Writing and reading the same rollouts with ccmarl and with Minari, in one run: CPU seconds, wall seconds, bytes.

usage: stores_beside_minari.py CCMARL WORK_DIR [--episodes N]     (needs minari[hdf5,create], gymnasium, numpy, pyarrow)

ccmarl records N episodes (worlds included), verifies them (every digest) and counts all columns (`inspect`). Minari gets the
same observations, messages, actions and team rewards as arrays in memory, writes them, and reads every episode back.
"""

import argparse
import os
import resource
import shutil
import subprocess
import time
from pathlib import Path

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("ccmarl")
parser.add_argument("work", type=Path)
parser.add_argument("--episodes", type=int, default=16000)
args = parser.parse_args()
args.work.mkdir(parents=True, exist_ok=True)
os.environ["MINARI_DATASETS_PATH"] = str(args.work / "minari")

import gymnasium as gym
import minari
import numpy as np
import pyarrow.parquet as pq
from minari.data_collector import EpisodeBuffer


def size(path: Path) -> int:
    return sum(p.stat().st_size for p in path.rglob("*") if p.is_file())


def timed(what, steps, work, who):
    before, start = resource.getrusage(who), time.perf_counter()
    result = work()
    after, wall = resource.getrusage(who), time.perf_counter() - start
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(f"{what},{steps / wall:.0f},{steps / cpu:.0f},{wall:.2f},{cpu:.2f}", flush=True)
    return result


def run(*words):
    subprocess.run([args.ccmarl, *words], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


print("what,steps_per_wall_s,steps_per_cpu_s,wall_s,cpu_s")
store, steps = args.work / "store", args.episodes * 25
record = ["record", "--scenario", "simple_spread", "--agents", "3", "--episodes", str(args.episodes), "--seed", "1"]
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
print(f"bytes: ccmarl {size(store)} (state, links and rewards per agent included), minari {size(args.work / 'minari')}")
