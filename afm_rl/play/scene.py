"""Robots as they are drawn: MuJoCo's own geoms, a rod, a robot on its track."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import trimesh

from afm_rl.film import BONE, bones, solid
from afm_rl.method_colours import colour_of

COLOURS = {name: tuple(bytes.fromhex(colour_of(name)[1:])) for name in ("without AFM", "with AFM")}
LANE = 1.6  # m from the middle to either robot


class MuJoCoFigure:
    """A MuJoCo robot in its lane, which runs below it as on a treadmill."""

    def __init__(self, server: Any, name: str, inner: Any, place: np.ndarray) -> None:
        self.inner, self.place, model = inner, place, inner.model
        self.root = server.scene.add_frame(f"/{name}", show_axes=False, position=place)
        shaped = {*model.geom_bodyid[solid(model)].tolist(), *bones(model)[:, 0].tolist()}
        self.bodies = {
            body: server.scene.add_frame(f"/{name}/{body}", show_axes=False) for body in shaped
        }
        for parent, child in bones(model):
            bone = trimesh.creation.cylinder(BONE, segment=[np.zeros(3), model.body_pos[child]])
            own = f"/{name}/{parent}/bone{child}"
            server.scene.add_mesh_simple(own, bone.vertices, bone.faces, color=COLOURS[name])
        for geom in solid(model):
            shape, own = shape_of(model, geom), f"/{name}/{model.geom_bodyid[geom]}/{geom}"
            look = {"color": COLOURS[name], "wxyz": model.geom_quat[geom]}
            spot = model.geom_pos[geom]
            server.scene.add_mesh_simple(own, shape.vertices, shape.faces, position=spot, **look)
        self.axes = ways_of(model)
        floor = (place[0], place[1], self._lowest())
        size = {"width": 12.0, "height": 2 * LANE - 0.2, "cell_size": 0.5, "section_size": 1.0}
        self.floor = server.scene.add_grid(
            f"/floor/{name}", **size, position=floor, plane_color=(225, 228, 232), plane_opacity=1.0
        )

    def _lowest(self) -> float:
        """Return the height of the floor; without one, a little below the robot."""
        planes = self.inner.model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        return float(self.inner.data.geom_xpos[planes, 2].min()) if planes.any() else -0.7

    def draw(self) -> None:
        """Put all bodies where they are."""
        data, shift = self.inner.data, np.zeros(3)
        shift[self.axes] = data.qpos[self.axes]
        _, y, z = self.floor.position
        self.floor.position = (self.place[0] - shift[0] % 1.0, y, z)
        self.root.position = self.place - shift
        self.label = self.place + [0.0, 0.0, data.xpos[1, 2] + 0.5]
        for body, frame in self.bodies.items():
            frame.position, frame.wxyz = data.xpos[body], data.xquat[body]


class PendulumFigure:
    """The rod of gymnasium's pendulum, which stands up at angle 0."""

    def __init__(self, server: Any, name: str, inner: Any, place: np.ndarray) -> None:
        self.inner, height = inner, np.array([0.0, 0.0, 1.0])
        place = -place[[1, 0, 2]]  # one beside the other
        self.label = place + 2.3 * height
        self.root = server.scene.add_frame(f"/{name}", show_axes=False, position=place + height)
        rod = trimesh.creation.capsule(height=1.0, radius=0.08)
        rod.apply_translation([0.0, 0.0, 0.5 - rod.bounds.mean(0)[2]])
        server.scene.add_mesh_simple(f"/{name}/rod", rod.vertices, rod.faces, color=COLOURS[name])
        server.scene.add_icosphere(f"/{name}/hinge", radius=0.1, color=(120, 120, 120))

    def draw(self) -> None:
        """Turn the rod."""
        half = -float(self.inner.state[0]) / 2
        self.root.wxyz = (np.cos(half), 0.0, np.sin(half), 0.0)


class GroundFigure:
    """A robot on its track; both drive on the same one."""

    def __init__(self, server: Any, name: str, inner: Any, place: np.ndarray) -> None:
        self.inner, track = inner, inner.native.tracks[0]
        line = track.centerline.numpy()
        self.middle = np.append(line.mean(0), 0.0)
        self.scale = 8.0 / np.ptp(line, axis=0).max()
        along = np.roll(line, -1, 0) - np.roll(line, 1, 0)
        across = np.c_[-along[:, 1], along[:, 0]] / np.linalg.norm(along, axis=1, keepdims=True)
        edges = [line + sign * across * track.width / 2 for sign in (-1, 1)]
        points = self._place(np.concatenate(edges))
        here = np.arange(len(line))
        after, other = np.roll(here, -1), here + len(line)
        faces = np.r_[np.c_[here, after, other], np.c_[after, np.roll(other, -1), other]]
        server.scene.add_mesh_simple("/track", points, faces, color=(205, 208, 212), side="double")
        self.root = server.scene.add_frame(f"/{name}", show_axes=False)
        cone = trimesh.creation.cone(radius=0.15, height=0.5)
        cone.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0]))
        look = {"color": COLOURS[name]}
        server.scene.add_mesh_simple(f"/{name}/robot", cone.vertices, cone.faces, **look)
        self.goal = server.scene.add_icosphere(f"/goal/{name}", 0.12, opacity=0.5, **look)

    def _place(self, points: np.ndarray) -> np.ndarray:
        """Return where points of the track ``(..., 2)`` are in the scene."""
        return (np.append(points, 0 * points[..., :1], -1) - self.middle) * self.scale

    def draw(self) -> None:
        """Put the robot and its target where they are."""
        data = self.inner._data
        *spot, theta = data["pose"].tolist()
        self.root.position = self._place(np.array(spot)) + [0, 0, 0.16]
        self.root.wxyz = (np.cos(theta / 2), 0.0, 0.0, np.sin(theta / 2))
        self.goal.position = self._place(data["goal"].numpy())
        self.label = self.root.position + [0, 0, 0.4]


class FlyingFigure:
    """A quadrotor as a cross, and the circle that it flies."""

    def __init__(self, server: Any, name: str, inner: Any, place: np.ndarray) -> None:
        self.inner, self.place = inner, 0.2 * place + [0.0, 0.0, 1.0]
        self.root = server.scene.add_frame(f"/{name}", show_axes=False)
        for arm, turn in enumerate((1, -1)):
            wxyz = (np.cos(np.pi / 8), 0.0, 0.0, turn * np.sin(np.pi / 8))
            server.scene.add_box(f"/{name}/{arm}", COLOURS[name], (0.5, 0.06, 0.06), wxyz=wxyz)
        self.goal = server.scene.add_icosphere(
            f"/goal/{name}", 0.06, opacity=0.5, color=COLOURS[name]
        )

    def draw(self) -> None:
        """Put the quadrotor and its reference where they are."""
        pose = self.inner._data["pose"].tolist()
        self.root.position = self.place + pose[:3]
        self.root.wxyz = (pose[9], *pose[6:9])
        self.goal.position = self.place + self.inner._data["reference"][0, :3].tolist()
        self.label = self.root.position + [0.0, 0.0, 0.3]


def figure_of(server: Any, name: str, inner: Any) -> Any:
    """Return what draws the robot of an environment."""
    place = np.array([0.0, LANE if name == "without AFM" else -LANE, 0.0])
    if hasattr(inner, "data"):
        return MuJoCoFigure(server, name, inner, place)
    if not hasattr(inner, "native"):
        return PendulumFigure(server, name, inner, place)
    kind = GroundFigure if hasattr(inner.native, "tracks") else FlyingFigure
    return kind(server, name, inner, place)


def ways_of(model: Any) -> list[int]:
    """Return which of x and y a robot can go along without a limit: 0, 1, both or none."""
    if model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE:
        return [0, 1]
    slides = (model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE) & ~model.jnt_limited.astype(bool)
    return [k for k in (0, 1) if slides[k : k + 1].any() and model.jnt_axis[k].argmax() == k]


def shape_of(model: Any, geom: Any) -> trimesh.Trimesh:
    """Return the shape of a geom, in its own frame."""
    kind, size = model.geom_type[geom], model.geom_size[geom]
    kinds = mujoco.mjtGeom
    if kind == kinds.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        start, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
        return trimesh.Trimesh(
            model.mesh_vert[first : first + count], model.mesh_face[start : start + faces]
        )
    if kind == kinds.mjGEOM_BOX:
        return trimesh.creation.box(2 * size)
    if kind == kinds.mjGEOM_CAPSULE:
        shape = trimesh.creation.capsule(height=2 * size[1], radius=size[0], count=(16, 16))
        shape.apply_translation([0.0, 0.0, -shape.bounds.mean(0)[2]])
        return shape
    if kind == kinds.mjGEOM_CYLINDER:
        return trimesh.creation.cylinder(radius=size[0], height=2 * size[1])
    shape = trimesh.creation.icosphere(subdivisions=2)
    shape.apply_scale(size if kind == kinds.mjGEOM_ELLIPSOID else size[0])
    return shape
