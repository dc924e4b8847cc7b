"""The kernel that casts the rays of depth images."""

from __future__ import annotations

import warp as wp


@wp.kernel
def cast(
    due: wp.array[wp.bool],
    camera: wp.array2d[wp.mat44],
    tangent: wp.array2d[float],
    pose: wp.array2d[wp.mat44],
    mesh: wp.array2d[wp.uint64],
    sphere: wp.array2d[wp.vec4],
    height: int,
    width: int,
    depth: wp.array3d[float],
    body: wp.array3d[wp.int16],
):
    """Cast the ray of one pixel; :class:`xreset.cameras.rays.RayCaster` explains the arrays."""
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
    body[world, view, pixel] = wp.int16(hit)
