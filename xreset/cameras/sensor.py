"""The depth cameras of N worlds: where they are, when they take an image, and what the policy gets of it.

Shape letters: N worlds, C cameras, H x W pixels, B bodies, P points.
"""

from __future__ import annotations

from dataclasses import astuple
from typing import Any

import numpy as np
import torch
import trimesh
from PIL import Image
from torch import Tensor

from xreset.cameras.config import VisionConfig
from xreset.cameras.rays import RayCaster
from xreset.errors import XResetError
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import homogeneous, quat_from_axis_angle, quat_to_matrix
from xreset.geometry.shapes import box, look_at, shape_mesh, transform, winding_number
from xreset.geometry.urdf import link_meshes
from xreset.physics import State
from xreset.physics.tensors import where
from xreset.spec import SceneSpec

_GOAL_COLOR = (0.3, 1.0, 0.3)


class Cameras:
    """Fixed buffers of N worlds. Apart from the rays, a step is torch operations that can be captured in a graph.

    Attributes:
        pose: [N, C, 4, 4] poses of the cameras: x to the right, y down, z forward.
        rays: what the cameras hit. The last body of a world is its object.
        shift: [N, C, 3] how far each camera is from where it should be, in its own frame [m].
        turn: [N, C, 3] rotation of each camera from how it should be, axis times angle, in its own frame [rad].
        fov_scale: [N, C] factor on the field of view.
        noise_scale: [N] factor on the errors of depth.
        image: [N, C, H, W] newest image with its errors [m]; 0 where a pixel sees nothing.
        view: [N, ...] what the policy gets of the newest images: :attr:`VisionConfig.view_shape`.
    """

    def __init__(
        self, scene: SceneSpec, object_index: Tensor, config: VisionConfig, *, scale: float = 1.0
    ) -> None:
        """Allocate, and start the renderer.

        Args:
            scene: the scene.
            object_index: [N] object of each world, on the device of everything.
            config: the cameras.
            scale: factor on the coordinates of points [1/m].

        Raises:
            XResetError: a camera is inside a body, or the renderer cannot start.
            RobotError: the robot has no such link.
        """
        self.config = config
        self._scale = scale
        device = object_index.device

        def tensor(values: Any) -> Tensor:
            return torch.as_tensor(np.asarray(values), dtype=torch.float32, device=device)

        self._kinematics = Kinematics(scene.robot, dtype=torch.float32, device=device)
        bodies = link_meshes(scene.robot)
        x, y, z = scene.table.half_size
        table = shape_mesh(box((*scene.table.center, -z), (2 * x, 2 * y, 2 * z)))
        self._mounted = tensor(self._mount(bodies, table))
        objects = [trimesh.Trimesh(o.vertices, o.faces, process=False) for o in scene.objects]
        first_object = len(bodies) + 1
        worlds = len(object_index)
        fixed = torch.arange(first_object, device=device).expand(worlds, -1)
        held = first_object + object_index[:, None]
        size = (config.height, config.width)
        count = len(config.cameras)
        surfaces = [*bodies.values(), table, *objects]
        self.pose = torch.eye(4, device=device).repeat(worlds, count, 1, 1)
        self._tangent = torch.ones(worlds, count, device=device)
        """[N, C] tangent of half the field of view."""
        self._due = torch.ones(worlds, dtype=torch.bool, device=device)
        views = (self.pose, self._tangent, self._due, size)
        self.rays = RayCaster(surfaces, torch.cat((fixed, held), dim=1), *views)
        self._goal_rays = RayCaster(objects, object_index[:, None], *views)
        limits = tensor([(c.near, c.far) for c in config.cameras])
        self._near, self._far = limits.T[..., None, None]
        noise = tensor([astuple(c.noise) for c in config.cameras])
        self._spread, self._step, self._holes, self._edges, self._edge = noise.T[..., None, None]
        self._half_fov = tensor([c.fov / 2 for c in config.cameras])
        y, x = torch.meshgrid(
            *(torch.arange(n, device=device) + 0.5 - n / 2 for n in size), indexing="ij"
        )
        # tangents of the rays' angles where half a field of view is 45 degrees
        self._pixels = torch.stack((x, y), dim=-1).flatten(0, 1) * 2 / config.height
        self.shift = torch.zeros(worlds, count, 3, device=device)
        self.turn = torch.zeros_like(self.shift)
        self.fov_scale = torch.ones(worlds, count, device=device)
        self.noise_scale = torch.ones(worlds, device=device)
        self.image = torch.zeros(worlds, count, *size, device=device)
        self._believed = torch.zeros(worlds, count, 4, 4, device=device)
        """[N, C, 4, 4] poses without ``shift`` and ``turn``, which the policy does not know."""
        self.view = torch.zeros(worlds, *config.view_shape, device=device)

    def aim(self, state: State, goal_pos: Tensor, goal_quat: Tensor, due: Tensor) -> None:
        """Put bodies and cameras where they are.

        Args:
            state: of all worlds.
            goal_pos: [N, 3] world frame [m].
            goal_quat: [N, 4]
            due: [N] bool: the worlds that take an image now.
        """
        rays = self.rays
        links = self._kinematics.link_poses(state.joint_pos, self._links)
        rays.pose[:, : self._num_links] = links[:, : self._num_links]
        rays.pose[:, -1] = homogeneous(quat_to_matrix(state.object_quat), state.object_pos)
        for i, mount in enumerate(self._mounts):
            self._believed[:, i] = (
                self._mounted[i] if mount is None else links[:, mount] @ self._mounted[i]
            )
        moved = homogeneous(quat_to_matrix(quat_from_axis_angle(self.turn)), self.shift)
        self.pose.copy_(self._believed @ moved)
        self._tangent.copy_((self.fov_scale * self._half_fov).tan())
        self._due.copy_(due)
        self._goal_rays.pose[:, 0] = homogeneous(quat_to_matrix(goal_quat), goal_pos)

    def cast(self) -> None:
        """Draw the images of the worlds that are due."""
        self.rays.cast()
        self._goal_rays.cast()

    def observe(self, generator: torch.Generator) -> Tensor:
        """[N, ...] points that the newest images show: :attr:`VisionConfig.view_shape`."""
        measured = self._with_errors(self.rays.depth, generator)
        self.image.copy_(where(self._due, measured, self.image))
        goal = self._in_range(self._goal_rays.depth)
        present = self._points(self.image, self._on_object(), generator)
        wanted = self._points(goal, goal > 0, generator)
        self.view.copy_(where(self._due, torch.stack((present, wanted), dim=1), self.view))
        return self.view

    def picture(self, world: int, width: int, *, goal: bool = True) -> np.ndarray:
        """Return the newest images of a world side by side, [h, width, 3] uint8: near is bright, nothing is black.

        Args:
            world: index of the world.
            width: width of the picture in pixels; its height is even.
            goal: whether the object at its goal is shown, in green.
        """
        images = self.image[world]
        nearness = (self._far - images) / (self._far - self._near)
        near = torch.where(images > 0, 0.2 + 0.8 * nearness, 0.0)
        colors = near[..., None].repeat(1, 1, 1, 3)
        if goal:
            at_goal = self._in_range(self._goal_rays.depth)[world] > 0
            colors[at_goal] = 0.5 * (colors[at_goal] + colors.new_tensor(_GOAL_COLOR))
        pixels = Image.fromarray((255 * torch.cat(tuple(colors), dim=1)).byte().cpu().numpy())
        height = 2 * round(width * pixels.height / pixels.width / 2)
        return np.asarray(pixels.resize((width, height), Image.Resampling.NEAREST))

    def shows_object(self) -> Tensor:
        """[N] bool: whether the newest images show the object, if they had no errors."""
        return (self._on_object() & (self._in_range(self.rays.depth) > 0)).flatten(1).any(dim=1)

    def _mount(
        self, bodies: dict[str, trimesh.Trimesh], table: trimesh.Trimesh
    ) -> list[np.ndarray]:
        """Choose the links whose poses are needed, those of the bodies first.

        Returns:
            The pose [4, 4] of each camera in the frame of its link or of the world.

        Raises:
            XResetError: a camera is inside the table or a link of the robot at home.
        """
        cameras = self.config.cameras
        kinematics = self._kinematics
        names = [kinematics.robot.palm if c.link == "palm" else c.link for c in cameras]
        self._num_links = len(bodies)
        self._mounts = [None if name is None else len(bodies) + i for i, name in enumerate(names)]
        self._links = [*bodies, *(name or kinematics.root for name in names)]
        poses = kinematics.link_poses(kinematics.home, self._links).cpu().numpy()
        mounted = [transform(look_at(c.pos, c.target).T, c.pos) for c in cameras]
        solids = {f"the robot's link {name!r}": mesh for name, mesh in bodies.items()}
        solids["the table"] = table
        places = [*poses[: len(bodies)], np.eye(4)]
        for number, camera in enumerate(cameras):
            mount = self._mounts[number]
            eye = mounted[number][:, 3]
            if mount is not None:
                eye = poses[mount] @ eye
            for (name, mesh), pose in zip(solids.items(), places, strict=True):
                local = np.linalg.inv(pose) @ eye
                if winding_number(local[None, :3], mesh.vertices, mesh.faces)[0] > 0.5:
                    raise XResetError(
                        f"Camera {number + 1} at {camera.pos} is inside {name} and sees nothing else. "
                        "Move it out (pos)."
                    )
        return mounted

    def _on_object(self) -> Tensor:
        """[N, C, H, W] bool: whether a pixel's ray hits the object, which is a world's last body."""
        return self.rays.body == self.rays.pose.shape[1] - 1

    def _in_range(self, depth: Tensor) -> Tensor:
        return torch.where((depth >= self._near) & (depth <= self._far), depth, 0.0)

    def _with_errors(self, depth: Tensor, generator: torch.Generator) -> Tensor:
        """Return depths [N, C, H, W] as a camera measures them; 0 where it does not."""
        scale = self.noise_scale.view(-1, 1, 1, 1)
        in_range = self._in_range(depth)
        inverse = torch.where(in_range > 0, 1.0 / in_range.clamp_min(1e-6), 0.0)
        lost = torch.where(
            _bend(inverse) * in_range.square() > self._edge,
            self._edges.maximum(self._holes),
            self._holes,
        )
        chance = torch.rand(depth.shape, generator=generator, device=depth.device)
        error = torch.randn(depth.shape, generator=generator, device=depth.device)
        measured = inverse + scale * self._spread * error
        step = scale * self._step
        measured = torch.where(step > 0, (measured / step.clamp_min(1e-9)).round() * step, measured)
        is_measured = (in_range > 0) & (chance >= scale * lost) & (measured > 0)
        return torch.where(is_measured, self._in_range(1.0 / measured.clamp_min(1e-6)), 0.0)

    def _points(self, image: Tensor, is_object: Tensor, generator: torch.Generator) -> Tensor:
        """Return P points [N, P, 4] of the object: coordinates in the world where the cameras are believed to be, and
        1, or zeros where fewer pixels show the object."""
        depth = image.flatten(2)
        offset = self._pixels * self._half_fov.tan().view(-1, 1, 1)  # [C, H W, 2]
        local = torch.cat((offset * depth[..., None], depth[..., None]), dim=-1)
        pose = self._believed
        world = (local @ pose[..., :3, :3].mT + pose[..., None, :3, 3]).flatten(1, 2)
        valid = (is_object.flatten(2) & (depth > 0)).flatten(1)
        order = torch.rand(valid.shape, generator=generator, device=valid.device) + valid.float()
        chosen = order.topk(self.config.points, dim=1).indices
        kept = valid.gather(1, chosen)[..., None].float()
        points = world.gather(1, chosen[..., None].expand(-1, -1, 3))
        return torch.cat((self._scale * points * kept, kept), dim=-1)


def _bend(inverse: Tensor) -> Tensor:
    """Return the larger second difference, across or down, of inverse depths [..., H, W].

    It is 0 on a plane, because there the inverse depth is linear in the pixels, and at the border of the picture.
    """
    bend = torch.zeros_like(inverse)
    bend[..., 1:-1] = inverse.diff(n=2).abs()
    bend[..., 1:-1, :] = bend[..., 1:-1, :].maximum(inverse.diff(n=2, dim=-2).abs())
    return bend
