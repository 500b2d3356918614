"""Writes a rollout store of schema version 1 that `ccmarl` opens, verifies and re-simulates: numpy and pyarrow only.

    from ccmarl_store import Agent, Episode, write_store

    agents = [Agent("agent_0", "agents", observation=18, action=5), ...]
    episode = Episode(state, observations, actions, rewards, reward)   # see below
    write_store("data/mine", scenario={"name": "simple_spread", "profile": "mpe2", "agents": 3},
                agents=agents, state_fields=["agent_0.x", ...], episodes=[episode])

then `ccmarl verify data/mine --resimulate`.
"""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq


@dataclass
class Agent:
    """One agent: its name, team and column widths. Who communicates has a message as wide as `message`."""

    name: str
    team: str
    observation: int
    action: int
    message: int = 0
    controller: str = "policy"
    learner: bool = True


@dataclass
class Episode:
    """T steps. Per agent lists hold one array per agent, in the order of the agents."""

    state: np.ndarray  # [T + 1, S] f64, world units
    observations: list[np.ndarray]  # [T + 1, observation] f32
    actions: list[np.ndarray]  # [T, action] f32
    rewards: list[np.ndarray]  # [T] f32
    reward: np.ndarray  # [T] f32, the team's
    messages: list[np.ndarray] | None = None  # [T + 1, message] f32
    link: np.ndarray | None = None  # [T + 1, N, N] bool over the communicators, sender by receiver
    terminal: bool = False


def content_hash(e: Episode) -> bytes:
    """SHA-256 of an episode's values, whatever file they are in."""
    digest = hashlib.sha256(b"ccmarl episode v1")
    digest.update(len(e.reward).to_bytes(8, "little") + bytes([e.terminal]))
    digest.update(e.state.astype("<f8").tobytes())
    for column in [*e.observations, *(e.messages or [])]:
        digest.update(column.astype("<f4").tobytes())
    if e.link is not None:
        digest.update(e.link.astype(np.uint8).tobytes())
    for column in [*e.actions, e.reward, *e.rewards]:
        digest.update(column.astype("<f4").tobytes())
    return digest.digest()


def write_store(out, scenario, agents, state_fields, episodes, link=None, policy=None, seed=0):
    """Writes the directory `out`: one Parquet part and the manifest."""
    out = Path(out)
    out.mkdir(parents=True)
    table = _table(agents, state_fields, episodes)
    part = out / "part-00000.parquet"
    floats = [c for c in table.column_names if pa.types.is_floating(_element(table.schema.field(c).type))]
    paths = {c: c + ".list.element" if pa.types.is_fixed_size_list(table.schema.field(c).type) else c for c in floats}
    pq.write_table(
        table,
        part,
        compression="zstd",
        use_dictionary=False,
        column_encoding={path: "BYTE_STREAM_SPLIT" for path in paths.values()},
    )
    content = hashlib.sha256(b"".join(content_hash(e) for e in episodes)).hexdigest()
    data = part.read_bytes()
    manifest = {
        "schema_version": 1,
        "ccmarl": "0.1.0",
        "kind": "rollouts",
        "seed": seed,
        "episodes": len(episodes),
        "steps": sum(len(e.reward) for e in episodes),
        "scenario": scenario,
        "link": link or {"name": "perfect"},
        "policy": policy or {"name": "external"},
        "agents": [
            {
                "name": a.name,
                "team": a.team,
                "controller": a.controller,
                "learner": a.learner,
                "communicator": a.message > 0,
                "observation": a.observation,
                "message": a.message,
                "action": a.action,
            }
            for a in agents
        ],
        "state_fields": state_fields,
        "content": content,
        "parts": [
            {
                "file": part.name,
                "episodes": [0, len(episodes)],
                "bytes": len(data),
                "sha256": hashlib.sha256(data).hexdigest(),
                "content": content,
            }
        ],
        "self_sha256": "0" * 64,
    }
    text = json.dumps(manifest, indent=2) + "\n"
    digest = hashlib.sha256(text.encode()).hexdigest()
    (out / "manifest.json").write_text(text.replace('"self_sha256": "' + "0" * 64, '"self_sha256": "' + digest))


def _element(kind):
    return kind.value_type if pa.types.is_fixed_size_list(kind) else kind


def _table(agents, state_fields, episodes) -> pa.Table:
    steps = [len(e.reward) for e in episodes]
    last = np.concatenate([np.arange(t + 1) == t for t in steps])
    columns = {
        "episode": pa.array(np.repeat(np.arange(len(episodes)), np.array(steps) + 1), pa.int64()),
        "step": pa.array(np.concatenate([np.arange(t + 1) for t in steps]), pa.int32()),
        "is_first": pa.array(np.concatenate([np.arange(t + 1) == 0 for t in steps])),
        "is_last": pa.array(last),
        "is_terminal": pa.array(np.concatenate([(np.arange(e_t + 1) == e_t) & e.terminal for e_t, e in zip(steps, episodes)])),
    }

    def rows(arrays, kind):
        """A list column over all rows; None in `arrays` is impossible, rows without an action are null."""
        flat = np.concatenate([np.asarray(a).reshape(len(a), -1) for a in arrays])
        width = flat.shape[1]
        return pa.FixedSizeListArray.from_arrays(pa.array(flat.ravel(), kind), width)

    def acted(arrays, kind, width):
        padded = [np.concatenate([np.asarray(a, np.float32).reshape(len(a), -1), np.zeros((1, width), np.float32)]) for a in arrays]
        flat = pa.array(np.concatenate(padded).ravel(), kind)
        return pa.FixedSizeListArray.from_arrays(flat, type=pa.list_(kind, width), mask=pa.array(last))

    def earned(arrays):
        padded = np.concatenate([np.append(np.asarray(a, np.float32), np.float32(0)) for a in arrays])
        return pa.array(padded, pa.float32(), mask=last)

    if state_fields:
        columns["state"] = rows([e.state for e in episodes], pa.float64())
    for i, a in enumerate(agents):
        columns["observation." + a.name] = rows([e.observations[i] for e in episodes], pa.float32())
    for i, a in enumerate(agents):
        if a.message:
            columns["message." + a.name] = rows([e.messages[i] for e in episodes], pa.float32())
    if any(a.message for a in agents):
        columns["link"] = rows([e.link for e in episodes], pa.bool_())
    for i, a in enumerate(agents):
        columns["action." + a.name] = acted([e.actions[i] for e in episodes], pa.float32(), a.action)
    columns["reward"] = earned([e.reward for e in episodes])
    for i, a in enumerate(agents):
        columns["reward." + a.name] = earned([e.rewards[i] for e in episodes])
    return pa.table(columns)
