"""Depth images of many worlds at once: one ray for each pixel, against the meshes of a world's bodies, in Warp.

The same kernel runs on the CPU and on a GPU, without a display, and draws the states of every engine. Shape letters: N
worlds, C cameras, B bodies, H x W pixels.
"""

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

from xreset.cameras.kernels import cast
from xreset.physics.torch_warp import TorchStream, quiet


class RayCaster:
    """Casts the rays of N worlds with C cameras each, and B bodies each.

    Attributes:
        pose: [N, B, 4, 4] poses of the bodies.
        depth: [N, C, H, W] distance along the view axis [m]; 0 where a ray hits nothing.
        body: [N, C, H, W] int16, index of the body that a ray hits, or -1.
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
        self.body = torch.zeros(*shape, *size, dtype=torch.int16, device=device)
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
                    pixels = size[0] * size[1]
                    self._launch = wp.launch(cast, (*shape, pixels), arrays, record_cmd=True)
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
        wp.array(np.asarray(mesh.vertices, np.float32), dtype=wp.vec3),
        wp.array(np.asarray(mesh.faces, np.int32).ravel(), dtype=int),
    )
