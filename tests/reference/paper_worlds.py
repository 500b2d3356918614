"""An independent simulation of profile `paper` in numpy, many episodes at once: reference returns of random and oracle
policies, for comparison with `ccmarl record --policy random|scripted --format json`.

usage: paper_worlds.py [--episodes N] [--seed S]      (needs numpy only)

Written from the facts of the scenarios, not from ccmarl: velocity moves first, contacts are softplus springs, the prey
takes the best of 100 points and is not scaled. Chasers push with all their might straight at the prey (largest component
1); everyone else's oracle wants 5 times the way left as its velocity. The spread oracle tries all permutations.
"""

import argparse
import itertools

import numpy as np

DT, DAMPING, FORCE, MARGIN = 0.1, 0.25, 100.0, 1e-3


class World:
    """E episodes of bodies: `p` [E, bodies, 2], `v` [E, agents, 2]."""

    def __init__(self, rng, episodes, sizes, accels, speeds, collide, arenas):
        self.agents = len(accels)
        self.size, self.accel = np.array(sizes), np.array(accels)[:, None]
        self.speed, self.collide = np.array(speeds)[:, None], collide
        self.p = np.stack([rng.uniform(-a, a, (episodes, 2)) for a in arenas], axis=1)
        self.v = np.zeros((episodes, self.agents, 2))

    def step(self, u):
        force = u * self.accel
        if self.collide:
            for a in range(self.agents):
                for b in range(len(self.size)):
                    if a != b:
                        d = self.p[:, a] - self.p[:, b]
                        r = np.linalg.norm(d, axis=1, keepdims=True)
                        pen = np.logaddexp(0, -(r - self.size[a] - self.size[b]) / MARGIN) * MARGIN
                        force[:, a] += FORCE * d / r * pen
        self.v = self.v * (1 - DAMPING) + force * DT
        speed = np.linalg.norm(self.v, axis=2, keepdims=True)
        self.v = np.where(speed > self.speed, self.v / np.maximum(speed, 1e-300) * self.speed, self.v)
        self.p[:, : self.agents] += self.v * DT

    def distance(self, a, b):
        return np.linalg.norm(self.p[:, a] - self.p[:, b], axis=-1)


def steer(world, targets):
    """Controls that head for `targets` [E, agents, 2] and brake in time."""
    wish = 5 * (targets - world.p[:, : world.agents])
    return np.clip((wish - (1 - DAMPING) * world.v) / (world.accel * DT), -1, 1)


def spread(rng, episodes, oracle, bonus=1.0):
    w = World(rng, episodes, [0.15] * 3, [5.0] * 3, [np.inf] * 3, True, [1.0] * 6)
    total, rows = np.zeros(episodes), np.arange(episodes)
    orders = np.array(list(itertools.permutations(range(3))))
    for _ in range(25):
        if oracle:
            d = np.linalg.norm(w.p[:, :3, None] - w.p[:, None, 3:], axis=3)
            best = orders[np.argmin([sum(d[:, a, o[a]] for a in range(3)) for o in orders], axis=0)]
            u = steer(w, w.p[rows[:, None], 3 + best])
        else:
            u = rng.uniform(-1, 1, (episodes, 3, 2))
        w.step(u)
        d = np.linalg.norm(w.p[:, :3, None] - w.p[:, None, 3:], axis=3).min(axis=1)
        shared = -d.sum(axis=1) + bonus * (d < 0.1).all(axis=1)
        close = np.linalg.norm(w.p[:, :3, None] - w.p[:, None, :3], axis=3) < 0.3  # itself included
        total += 3 * shared - close.sum(axis=(1, 2))
    return total


def tag(rng, episodes, oracle, predators=3, prey_accel=1.0, score="sum"):
    n = predators
    sizes, arenas = [0.075] * n + [0.05] + [0.2] * 2, [1.0] * (n + 1) + [0.9] * 2
    w = World(rng, episodes, sizes, [3.0] * n + [prey_accel], [1.0] * n + [1.3], True, arenas)
    total = np.zeros(episodes)
    for _ in range(25):
        way = w.p[:, n : n + 1] - w.p[:, :n]
        chase = way / np.abs(way).max(axis=2, keepdims=True)
        u = chase if oracle else rng.uniform(-1, 1, (episodes, n, 2))
        angle, radius = rng.uniform(0, 2 * np.pi, (episodes, 100)), np.sqrt(rng.uniform(0, 1, (episodes, 100)))
        points = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=2)
        blocked = np.zeros((episodes, 100), bool)
        for k in range(1, 6):
            d = np.linalg.norm(points[:, :, None] * k / 5 + way[:, None], axis=3)
            blocked |= (d < 0.125).any(axis=2)
        d = np.linalg.norm(points[:, :, None] + way[:, None], axis=3)
        value = np.where(blocked, -1e7, 0) + (d.sum(axis=2) if score == "sum" else d.min(axis=2))
        best = value.argmax(axis=1)
        push = np.where(value.max(axis=1)[:, None] < 0, 0, points[np.arange(episodes), best])
        w.step(np.concatenate([u, push[:, None]], axis=1))
        total += 10 * (np.linalg.norm(w.p[:, n : n + 1] - w.p[:, :n], axis=2) < 0.125).sum(axis=1)
    return total


def reference(rng, episodes, oracle):
    goals, rows = rng.integers(0, 3, (episodes, 2)), np.arange(episodes)
    w = World(rng, episodes, [0.05] * 5, [5.0] * 2, [np.inf] * 2, True, [1.0] * 5)
    total = np.zeros(episodes)
    for _ in range(25):
        targets = w.p[rows[:, None], 2 + goals]
        w.step(steer(w, targets) if oracle else rng.uniform(-1, 1, (episodes, 2, 2)))
        there = (np.linalg.norm(w.p[:, :2] - targets, axis=2) < 0.1).sum(axis=1)
        total += 10.0 * there
    return total


def adversary(rng, episodes, oracle):
    # nobody touches, and only the adversary's distance counts: the goal is the first landmark
    w = World(rng, episodes, [0.15], [5.0], [np.inf], False, [1.0, 1.0])
    total = np.zeros(episodes)
    for _ in range(25):
        w.step(steer(w, w.p[:, 1:]) if oracle else rng.uniform(-1, 1, (episodes, 1, 2)))
        total -= w.distance(0, 1) ** 2
    return total


CASES = {
    "simple_spread": spread,
    "simple_spread cover_bonus=0": lambda *a: spread(*a, bonus=0.0),
    "simple_tag": tag,
    "simple_tag agents=6": lambda *a: tag(*a, predators=6),
    "simple_tag agents=9": lambda *a: tag(*a, predators=9),
    "simple_tag prey_score=min": lambda *a: tag(*a, score="min"),
    "simple_tag prey_accel=4": lambda *a: tag(*a, prey_accel=4.0),
    "simple_reference": reference,
    "simple_adversary": adversary,
}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    for number, (name, case) in enumerate(CASES.items()):
        for oracle in (False, True):
            total = case(np.random.default_rng([args.seed, number, oracle]), args.episodes, oracle)
            policy = "scripted" if oracle else "random"
            print(f"{name},{policy},{total.mean():.3f},{total.std():.3f},{total.std() / len(total) ** 0.5:.3f}", flush=True)
