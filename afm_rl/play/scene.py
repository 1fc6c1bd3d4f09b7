"""Robots as they are drawn: MuJoCo's own geoms, a rod, a robot on its track."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import trimesh

COLOURS = {"alone": (213, 94, 0), "AFM": (0, 114, 178)}
LANE = 1.6  # m from the middle to either robot
GROUND, TRACK, LINE = (225, 228, 232), (205, 208, 212), (120, 120, 120)


class MuJoCoFigure:
    """A MuJoCo robot in its lane, which runs below it as on a treadmill.

    Args:
        server: of viser.
        name: of the side.
        inner: the innermost environment.
        place: where the lane is (m), ``(3,)``.
    """

    def __init__(self, server: Any, name: str, inner: Any, place: np.ndarray) -> None:
        self.inner, self.place, model = inner, place, inner.model
        self.root = server.scene.add_frame(f"/{name}", show_axes=False, position=place)
        solid = np.flatnonzero(model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE)
        self.bodies = {
            body: server.scene.add_frame(f"/{name}/{body}", show_axes=False)
            for body in {int(model.geom_bodyid[geom]) for geom in solid}
        }
        for geom in solid:
            shape, own = shape_of(model, geom), f"/{name}/{model.geom_bodyid[geom]}/{geom}"
            look = {"color": COLOURS[name], "wxyz": model.geom_quat[geom]}
            spot = model.geom_pos[geom]
            server.scene.add_mesh_simple(own, shape.vertices, shape.faces, position=spot, **look)
        first = {int(kind) for kind in model.jnt_type[:1]}
        self.runs = mujoco.mjtJoint.mjJNT_FREE in first or model.joint(0).name == "rootx"
        free = mujoco.mjtJoint.mjJNT_FREE in first or model.joint(1).name == "slider2"
        self.axes = [0, 1] if free else [0]
        floor = (place[0], place[1], self._lowest())
        size = {"width": 12.0, "height": 2 * LANE - 0.2, "cell_size": 0.5, "section_size": 1.0}
        self.floor = server.scene.add_grid(
            f"/floor/{name}", **size, position=floor, plane_color=GROUND, plane_opacity=1.0
        )

    def _lowest(self) -> float:
        """Return the height of the floor; without one, a little below the robot."""
        planes = self.inner.model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        return float(self.inner.data.geom_xpos[planes, 2].min()) if planes.any() else -0.7

    @property
    def distance(self) -> float:
        """How far the robot is from where it began (m)."""
        return float(self.inner.data.qpos[0])

    def draw(self) -> None:
        """Put all bodies where they are."""
        data = self.inner.data
        shift = np.zeros(3)
        if self.runs:
            shift[self.axes] = data.qpos[self.axes]
            moved = np.zeros(3)
            moved[0] = shift[0] % 1.0
            x, y, z = self.floor.position
            self.floor.position = (self.place[0] - moved[0], y, z)
        self.root.position = self.place - shift
        for body, frame in self.bodies.items():
            frame.position, frame.wxyz = data.xpos[body], data.xquat[body]


class PendulumFigure:
    """The rod of gymnasium's pendulum, which stands up at angle 0."""

    def __init__(self, server: Any, name: str, inner: Any, place: np.ndarray) -> None:
        self.inner, height = inner, np.array([0.0, 0.0, 1.2])
        self.root = server.scene.add_frame(f"/{name}", show_axes=False, position=place + height)
        rod = trimesh.creation.capsule(height=1.0, radius=0.08)
        rod.apply_translation([0.0, 0.0, 0.5 - rod.bounds.mean(0)[2]])
        server.scene.add_mesh_simple(f"/{name}/rod", rod.vertices, rod.faces, color=COLOURS[name])
        server.scene.add_icosphere(f"/{name}/hinge", radius=0.1, color=LINE)
        self.distance = 0.0

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
        self.scale = 6.0 / np.ptp(line, axis=0).max()
        ring = np.c_[line, np.zeros(len(line))]
        ring = (np.r_[ring, ring[:1]] - self.middle) * self.scale
        server.scene.add_line_segments(
            "/track", np.stack([ring[:-1], ring[1:]], 1), TRACK, thickness=track.width * self.scale
        )
        cone = trimesh.creation.cone(radius=0.16, height=0.5)
        cone.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0]))
        server.scene.add_mesh_simple(f"/{name}", cone.vertices, cone.faces, color=COLOURS[name])
        self.root = server.scene.add_frame(f"/{name}", show_axes=False)
        server.scene.add_mesh_simple(
            f"/{name}/robot", cone.vertices, cone.faces, color=COLOURS[name]
        )
        self.goal = server.scene.add_icosphere(
            f"/goal/{name}", radius=0.12, color=COLOURS[name], opacity=0.5
        )
        self.distance = 0.0

    def draw(self) -> None:
        """Put the robot and its target where they are."""
        data = self.inner._data
        x, y, theta = data["pose"].tolist()
        self.root.position = (np.array([x, y, 0.0]) - self.middle) * self.scale + [0, 0, 0.16]
        self.root.wxyz = (np.cos(theta / 2), 0.0, 0.0, np.sin(theta / 2))
        goal = np.append(data["goal"].numpy(), 0.0)
        self.goal.position = (goal - self.middle) * self.scale


def figure_of(server: Any, name: str, inner: Any) -> Any:
    """Return what draws the robot of an environment."""
    place = np.array([0.0, LANE if name == "alone" else -LANE, 0.0])
    if hasattr(inner, "data"):
        return MuJoCoFigure(server, name, inner, place)
    kind = GroundFigure if hasattr(inner, "native") else PendulumFigure
    return kind(server, name, inner, place)


def shape_of(model: Any, geom: int) -> trimesh.Trimesh:
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
