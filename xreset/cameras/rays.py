"""Depth images of many worlds at once: one ray for each pixel, against the meshes of a world's bodies, in Warp.

The same kernel runs on the CPU and on a GPU, without a display, and draws the states of every engine. Shape letters: N
worlds, C cameras, B bodies, H x W pixels.
"""

# Warp compiles the kernels from their source; to a type checker of Python they make no sense.
# pyright: reportArgumentType=false, reportCallIssue=false, reportIndexIssue=false, reportGeneralTypeIssues=false, reportAssignmentType=false

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import trimesh
from torch import Tensor

from xreset.errors import XResetError, needs
from xreset.geometry.collision import bounding_ball

with needs("warp", "cameras"):
    import warp as wp

from xreset.torch_warp import TorchStream, quiet


@wp.kernel
def _cast(
    due: wp.array[wp.bool],
    camera: wp.array2d[wp.mat44],
    tangent: wp.array2d[float],
    pose: wp.array2d[wp.mat44],
    mesh: wp.array2d[wp.uint64],
    sphere: wp.array2d[wp.vec4],
    height: int,
    width: int,
    depth: wp.array3d[float],
    body: wp.array3d[wp.int8],
):
    world, view, pixel = wp.tid()
    if not due[world]:
        return
    scale = 2.0 * tangent[world, view] / float(height)
    right = (float(pixel % width) + 0.5 - 0.5 * float(width)) * scale
    down = (float(pixel // width) + 0.5 - 0.5 * float(height)) * scale
    length = wp.sqrt(1.0 + right * right + down * down)
    eye = camera[world, view]
    start = wp.vec3(eye[0, 3], eye[1, 3], eye[2, 3])
    ray = wp.transform_vector(eye, wp.vec3(right, down, 1.0)) / length
    nearest = wp.float32(1.0e6)
    hit = wp.int32(-1)
    for i in range(pose.shape[1]):
        T = pose[world, i]
        turn = wp.transpose(T)
        local = wp.transform_vector(turn, start - wp.vec3(T[0, 3], T[1, 3], T[2, 3]))
        along = wp.transform_vector(turn, ray)
        ball = sphere[world, i]
        to_center = wp.vec3(ball[0], ball[1], ball[2]) - local
        middle = wp.dot(to_center, along)
        inside = ball[3] * ball[3] - wp.dot(to_center, to_center) + middle * middle
        if inside > 0.0:
            half = wp.sqrt(inside)
            if middle + half > 0.0 and middle - half < nearest:
                query = wp.mesh_query_ray(mesh[world, i], local, along, nearest)
                if query.result:
                    nearest = query.t
                    hit = i
    depth[world, view, pixel] = wp.where(hit < 0, 0.0, nearest / length)
    body[world, view, pixel] = wp.int8(hit)


class RayCaster:
    """Casts the rays of N worlds with C cameras each, and B bodies each.

    Attributes:
        pose: [N, B, 4, 4] poses of the bodies.
        depth: [N, C, H, W] distance along the view axis [m]; 0 where a ray hits nothing.
        body: [N, C, H, W] int8, index of the body that a ray hits, or -1.
    """

    def __init__(
        self,
        meshes: Sequence[trimesh.Trimesh],
        bodies: Tensor,
        camera: Tensor,
        tangent: Tensor,
        due: Tensor,
        size: tuple[int, int],
    ) -> None:
        """Build the meshes' trees and compile the kernel. The buffers of the cameras are read whenever rays are cast.

        Args:
            meshes: closed surfaces.
            bodies: [N, B] index of each body's mesh.
            camera: [N, C, 4, 4] poses of the cameras: x to the right, y down, z forward.
            tangent: [N, C] tangent of half the vertical field of view.
            due: [N] bool: the worlds whose images :meth:`cast` draws; the other images stay.
            size: height and width [pixels].

        Raises:
            XResetError: Warp cannot be used here.
        """
        shape = tangent.shape
        device = bodies.device
        self.pose = torch.eye(4, device=device).repeat(*bodies.shape, 1, 1)
        self.depth = torch.zeros(*shape, *size, device=device)
        self.body = torch.zeros(*shape, *size, dtype=torch.int8, device=device)
        balls = [bounding_ball(mesh.vertices) for mesh in meshes]
        spheres = torch.tensor([(*center, radius) for center, radius in balls], dtype=torch.float32)
        self._sphere = spheres[bodies.cpu()].to(device)
        try:
            with quiet():
                self._on_stream = TorchStream(device)
                with self._on_stream():
                    self._meshes = [_warp_mesh(mesh) for mesh in meshes]
                    ids = torch.tensor([mesh.id for mesh in self._meshes])
                    self._ids = ids[bodies.cpu()].to(device)
                    arrays = [
                        wp.from_torch(due, dtype=wp.bool),
                        wp.from_torch(camera, dtype=wp.mat44),
                        wp.from_torch(tangent),
                        wp.from_torch(self.pose, dtype=wp.mat44),
                        wp.from_torch(self._ids, dtype=wp.uint64),
                        wp.from_torch(self._sphere, dtype=wp.vec4),
                        *size,
                        wp.from_torch(self.depth.flatten(2)),
                        wp.from_torch(self.body.flatten(2)),
                    ]
                    self._launch = wp.launch(
                        _cast, (*shape, size[0] * size[1]), arrays, record_cmd=True
                    )
        except Exception as error:  # a missing compiler or driver may fail in any way
            other = "--device cpu, or " if device.type != "cpu" else ""
            raise XResetError(
                f"The renderer of depth images cannot start on {device}: {error}. Use {other}a policy without cameras."
            ) from error

    def cast(self) -> None:
        """Draw the images of the worlds that are due. Nothing waits for a GPU."""
        with self._on_stream():
            self._launch.launch()


def _warp_mesh(mesh: trimesh.Trimesh) -> Any:
    return wp.Mesh(
        wp.array(np.float32(mesh.vertices), dtype=wp.vec3),
        wp.array(np.int32(mesh.faces).ravel(), dtype=int),
    )
