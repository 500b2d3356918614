"""Reads the viewers' topics of an MCAP store with Foxglove's own schemas and with Rerun, and compares what they draw
with the rows of /rollout/step.

usage: read_scene.py STORE.mcap RECORDING.rrd [PICTURE.png]
       (the .rrd is what `rerun mcap convert` made of the store; a picture needs matplotlib)
"""

import sys
from pathlib import Path

import numpy as np
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader


def rows(store: Path):
    """Per row: the manifest's state fields, the decoded step, scene and poses."""
    import json

    with store.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        manifest = next(m for m in reader.iter_metadata() if m.name == "ccmarl.manifest")
        manifest = json.loads(manifest.metadata["json"])
    step_class, row = None, {}
    with store.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            if channel.topic == "/rollout/step":
                if step_class is None:
                    pool = descriptor_pool.DescriptorPool()
                    for one in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                        pool.Add(one)
                    step_class = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
                row = {"step": step_class.FromString(message.data)}
            elif channel.topic == "/scene":
                assert schema.name == "foxglove.SceneUpdate"
                row["scene"] = SceneUpdate.FromString(message.data)
            elif channel.topic == "/poses":
                assert schema.name == "foxglove.PosesInFrame"
                row["poses"] = PosesInFrame.FromString(message.data)
                yield manifest, row["step"], row["scene"], row["poses"]


def xy(pose) -> tuple[float, float]:
    assert pose.orientation.w == 1 and pose.position.z == 0
    return pose.position.x, pose.position.y


def check_row(manifest: dict, step, scene, poses) -> list[tuple[float, float]]:
    """Compares one row; the places of the agents."""
    state = dict(zip(manifest["state_fields"], step.state))
    place = lambda name: (state[f"{name}.x"], state[f"{name}.y"])
    agents = [agent["name"] for agent in manifest["agents"]]
    others = [f[:-2] for f in manifest["state_fields"] if f.endswith(".x") and f[:-2] not in agents]
    spheres, cylinders, lines = scene.entities[0].spheres, scene.entities[1].cylinders, scene.entities[2].lines
    assert [e.id for e in scene.entities] == ["agents", "landmarks", "links"]
    assert [xy(s.pose) for s in spheres] == [place(a) for a in agents] == [xy(p) for p in poses.poses]
    assert [xy(c.pose) for c in cylinders] == [place(o) for o in others]
    talkers = [a["name"] for a in manifest["agents"] if a["communicator"]]
    links = {True: [], False: []}
    for i, sender in enumerate(talkers):
        for j, receiver in enumerate(talkers):
            if i != j:
                links[step.link[i * len(talkers) + j]].append((place(sender), place(receiver)))
    drawn = {}
    for line in lines:
        assert line.type == line.LINE_LIST and len(line.points) % 2 == 0
        ends = [(p.x, p.y) for p in line.points]
        drawn[line.color.g > line.color.r] = list(zip(ends[::2], ends[1::2]))
    for bit, pairs in links.items():
        middle = [(a, ((a[0] + b[0]) / 2, (a[1] + b[1]) / 2)) for a, b in pairs]
        assert np.allclose(drawn.get(bit, []), middle), (drawn.get(bit), middle)
    return [place(a) for a in agents]


def check_rerun(recording: Path, places: list) -> None:
    import rerun as rr

    with rr.server.Server(datasets={"store": [str(recording)]}) as server:
        poses = server.client().get_dataset("store").filter_contents(["/poses"])
        table = poses.reader(index="message_log_time").to_arrow_table().sort_by("message_log_time")
    found = np.array(table["/poses:InstancePoses3D:translations"].to_pylist(), dtype=np.float32)
    assert np.array_equal(found[:, :, :2], np.array(places, dtype=np.float32)) and not found[:, :, 2].any()


def draw(scene, picture: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6, 6))
    rgb = lambda color: (color.r, color.g, color.b)
    for cylinder in scene.entities[1].cylinders:
        axes.add_patch(plt.Circle(xy(cylinder.pose), cylinder.size.x / 2, color=rgb(cylinder.color)))
    for line in scene.entities[2].lines:
        for a, b in zip(line.points[::2], line.points[1::2]):
            axes.plot([a.x, b.x], [a.y, b.y], color=rgb(line.color), linewidth=2)
    for sphere in scene.entities[0].spheres:
        axes.add_patch(plt.Circle(xy(sphere.pose), sphere.size.x / 2, color=rgb(sphere.color)))
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.set_title("/scene, one row: links green, lost ones red", fontsize=10)
    figure.savefig(picture, dpi=120)


def main() -> None:
    store, recording = Path(sys.argv[1]), Path(sys.argv[2])
    places = []
    for number, row in enumerate(rows(store)):
        places.append(check_row(*row))
        if number >= 12 and len(row[2].entities[2].lines) == 2 and len(sys.argv) > 3:
            draw(row[2], Path(sys.argv.pop(3)))  # the first row that has both delivered and lost links
    print(f"ok foxglove {store}: {len(places)} scenes and poses")
    check_rerun(recording, places)
    print(f"ok rerun {store}: {len(places)} rows of poses")


if __name__ == "__main__":
    main()
