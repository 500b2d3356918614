"""Plays mpe2 1.1.1 and writes what it did as ccmarl stores, one per case: the truth that profile `mpe2` is held to.

usage: record.py OUT [--seed S] [--case NAME]...      (packages: requirements.txt)

Odd episodes hold every action for eight steps, so that bodies reach their top speeds, meet and leave the arena.
"""

import argparse
import importlib
import importlib.metadata
import os
from pathlib import Path

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")

import numpy as np

from ccmarl_store import Agent, Episode, write_store

# case: module, mpe2's arguments, ours, episodes
CASES = {}
for n, episodes in [(1, 2), (3, 6), (6, 4), (12, 2)]:
    CASES[f"spread-{n}"] = ("simple_spread_v3", {"N": n}, {"name": "simple_spread", "agents": n}, episodes)
for n, episodes in [(1, 4), (3, 8), (6, 4), (9, 4)]:
    CASES[f"tag-{n}"] = ("simple_tag_v3", {"num_adversaries": n}, {"name": "simple_tag", "agents": n}, episodes)
CASES["tag-3-obstacles-5"] = (
    "simple_tag_v3",
    {"num_obstacles": 5},
    {"name": "simple_tag", "agents": 3, "obstacles": 5},
    4,
)
CASES["reference"] = ("simple_reference_v3", {}, {"name": "simple_reference"}, 8)
for n, episodes in [(1, 4), (2, 8), (5, 4)]:
    ours = {"name": "simple_adversary", "agents": n + 1}
    CASES[f"adversary-{n + 1}"] = ("simple_adversary_v3", {"N": n}, ours, episodes)
CASES["spread-3-local"] = (
    "simple_spread_v3",
    {"local_ratio": 0.2, "max_cycles": 40},
    {"name": "simple_spread", "agents": 3, "local_ratio": 0.2, "steps": 40},
    2,
)


def state_row(world, goals) -> list[float]:
    row = []
    for agent in world.agents:
        row += [*agent.state.p_pos, *agent.state.p_vel]
        if not agent.silent:
            row += [*agent.state.c]
    for landmark in world.landmarks:
        row += [*landmark.state.p_pos]
    return row + goals


def goals_of(name, world) -> list[float]:
    """The landmark that each agent itself must reach: mpe2 keeps it with the other agent in simple_reference."""
    number = {id(landmark): i for i, landmark in enumerate(world.landmarks)}
    if name == "simple_reference":
        return [float(number[id(world.agents[1 - i].goal_b)]) for i in range(2)]
    if name == "simple_adversary":
        return [float(number[id(agent.goal_a)]) for agent in world.agents]
    return []


def fields_of(world, goals) -> list[str]:
    names = []
    for agent in world.agents:
        names += [f"{agent.name}.{c}" for c in ("x", "y", "vx", "vy")]
        if not agent.silent:
            names += [f"{agent.name}.c{i}" for i in range(world.dim_c)]
    names += [f"landmark_{i}.{c}" for i in range(len(world.landmarks)) for c in ("x", "y")]
    return names + [f"goal.{agent.name}" for agent in world.agents if goals]


def one_hot(choice, words) -> np.ndarray:
    row = np.zeros(5 + words, np.float32)
    row[choice % 5] = 1
    if words:
        row[5 + choice // 5] = 1
    return row


def play(env, name, seed, index, continuous, words):
    rng = np.random.default_rng([seed, index])
    seen, _ = env.reset(seed=int(rng.integers(2**31)))
    world = env.aec_env.unwrapped.world
    goals = goals_of(name, world)
    agents = [agent.name for agent in world.agents]
    states, observed = [state_row(world, goals)], [[seen[a] for a in agents]]
    taken, earned = [], []
    while env.agents:
        step = len(taken)
        if step % 8 == 0 or index % 2 == 0:
            if continuous:
                acts = {a: rng.random(env.action_space(a).shape, dtype=np.float32) for a in agents}
            else:
                acts = {a: int(rng.integers(env.action_space(a).n)) for a in agents}
        seen, rewards, *_ = env.step(acts)
        states.append(state_row(world, goals))
        observed.append([seen[a] for a in agents])
        taken.append([acts[a] if continuous else one_hot(acts[a], words) for a in agents])
        earned.append([rewards[a] for a in agents])
    by_agent = lambda rows, i: np.stack([row[i] for row in rows]).astype(np.float32)
    episode = Episode(
        state=np.array(states, np.float64),
        observations=[by_agent(observed, i) for i in range(len(agents))],
        actions=[by_agent(taken, i) for i in range(len(agents))],
        rewards=[by_agent(earned, i) for i in range(len(agents))],
        reward=np.array(earned, np.float64).sum(axis=1).astype(np.float32),
    )
    return episode, agents, fields_of(world, goals)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--case", action="append", choices=sorted(CASES))
    args = parser.parse_args()
    assert importlib.metadata.version("mpe2") == "1.1.1", "the truth is mpe2 1.1.1"
    for case, (module, theirs, ours, episodes) in CASES.items():
        if args.case and case not in args.case:
            continue
        for continuous in (True, False):
            arguments = {"max_cycles": 25, **theirs, "continuous_actions": continuous}
            env = importlib.import_module(f"mpe2.{module}").parallel_env(**arguments)
            env.reset(seed=0)
            world = env.aec_env.unwrapped.world
            words = 0 if world.agents[0].silent else world.dim_c
            played = [play(env, ours["name"], args.seed, i, continuous, words) for i in range(episodes)]
            _, names, fields = played[0]
            widths = [o.shape[1] for o in played[0][0].observations]
            agents = [Agent(a, a.rsplit("_", 1)[0], widths[i], 5 + words) for i, a in enumerate(names)]
            scenario = {**ours, "profile": "mpe2", "discrete": not continuous}
            out = args.out / f"{case}-{'continuous' if continuous else 'discrete'}"
            policy = {"name": "random", "by": "mpe2 1.1.1"}
            write_store(out, scenario, agents, fields, [e for e, *_ in played], policy=policy, seed=args.seed)
            print(out, f"{episodes} episodes", flush=True)


if __name__ == "__main__":
    main()
