"""The web page: a viser server that shows one row of a view at a time, and the controls that choose it."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from ipaddress import ip_address
from socket import getfqdn, gethostname
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import torch

from xreset.errors import XResetError, needs
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import matrix_to_quat
from xreset.geometry.urdf import link_meshes
from xreset.pictures.meshes import (
    GOAL_COLOR,
    OBJECT_COLOR,
    TABLE_COLORS,
    Color,
    link_colors,
    rgb,
    tint,
)
from xreset.pictures.render import Camera
from xreset.pictures.view.colors import CONTACT_COLOR, HUMAN_COLOR, REACHED_COLOR, TOUCH_COLOR, reason_color
from xreset.pictures.view.data import BONES, GOOD, PHASES, View
from xreset.pictures.view.timeline import bar, legend, mark
from xreset.spec import TableSpec

_ALL = "all"
_IDLE = 0.1
"""Time between two checks of the play button [s]."""


class Page:
    """A page at :attr:`url` until :meth:`close`. All visitors see, and move, the same controls."""

    def __init__(
        self, view: View, *, host: str = "127.0.0.1", port: int = 8080, sequence: int | None = None, frame: int = 0
    ) -> None:
        """Start the server.

        Args:
            host: address to listen at; 0.0.0.0 for every address of the machine.
            port: port to listen at; the next free one if it is taken.
            sequence: first sequence to show; None: all of a bank, the first of another file.
            frame: first row to show, within the sequence.

        Raises:
            XResetError: viser is not installed, the server does not start, or the sequence or frame is unknown.
        """
        with needs("viser, without which --png and --mp4 work,", "viewer"):
            import viser
        self.view = view
        if sequence is None and view.kind != "reset states":
            sequence = 0
        self._rows = view.choose(sequence=sequence)
        if not 0 <= frame < len(self._rows):
            raise XResetError(f"There is no frame {frame}: the sequence has {len(self._rows)}, counted from 0.")
        self._lock = threading.RLock()
        try:
            with _own_page_only(host) as guarded:
                self._server = viser.ViserServer(host=host, port=port, label="xreset view", verbose=False)
        except OSError as error:
            raise XResetError(
                f"Cannot serve the page at {host}:{port}: {error}. Choose another --host or --port."
            ) from error
        if not guarded:
            self.close()
            raise XResetError("This version of viser cannot be restricted to its own page. Install viser 1.1.")
        self._scene = _Scene(view, self._server)
        self._make_controls(sequence)
        self._show_choice()
        self._frame.value = frame
        self.show()

    @property
    def url(self) -> str:
        """Address of the page, seen from this machine."""
        host = self._server.get_host()
        if host in ("0.0.0.0", "127.0.0.1"):
            host = "localhost"
        return f"http://{host}:{self._server.get_port()}"

    @property
    def row(self) -> int | None:
        """The row that is shown; None if no row meets the controls."""
        if not len(self._rows):
            return None
        return int(self._rows[min(self._frame.value, len(self._rows) - 1)])

    def show(self) -> None:
        """Update the scene and the text from the controls."""
        with self._lock, self._server.atomic():
            row = self.row
            self._scene.show(row)
            if row is None:
                self._mark.content = ""
                self._text.content = "nothing meets this choice"
                return
            self._mark.content = mark(self._frame.value, len(self._rows))
            first, *others = self.view.text(row)
            position = f"{self._frame.value + 1} of {len(self._rows)}"
            self._text.content = "\n\n".join((f"**{first}**", *others, position))

    def serve(self) -> None:
        """Play while the play button is on, until interrupted."""
        while True:
            if self._play.value and len(self._rows) > 1:
                time.sleep(1.0 / (self.view.rate * self._speed.value))
                self._step(1)
            else:
                time.sleep(_IDLE)

    def close(self) -> None:
        """Stop the server."""
        self._server.stop()

    def _make_controls(self, sequence: int | None) -> None:
        gui: Any = self._server.gui
        view = self.view
        self._reasons = {}
        for reason, count in view.counts().items():
            if count:
                self._reasons[f"{reason or GOOD[view.kind]} ({count})"] = reason
        names = [f"{number}: {name}" for number, name in enumerate(view.sequence_name)]
        objects = [spec.name for spec in view.objects]
        first = _ALL if sequence is None else names[sequence]
        self._sequence = gui.add_dropdown("sequence", [_ALL, *names], initial_value=first)
        self._object = gui.add_dropdown("object", [_ALL, *objects])
        self._phase = gui.add_dropdown("phase", [_ALL, *PHASES])
        self._reason = gui.add_dropdown("state", [_ALL, *self._reasons], visible=bool(view.reasons))
        label = "number" if view.kind == "reset states" else "frame"
        self._frame = gui.add_slider(label, 0, _slider_end(self._rows), 1, 0)
        gui.add_button("previous").on_click(lambda _: self._step(-1))
        gui.add_button("next").on_click(lambda _: self._step(1))
        self._play = gui.add_checkbox("play", False)
        self._speed = gui.add_slider("speed", 0.1, 2.0, 0.1, 1.0)
        self._bar = gui.add_html("")
        self._mark = gui.add_html("")
        self._legend = gui.add_html("")
        self._text = gui.add_markdown("")
        for control in (self._sequence, self._object, self._phase, self._reason):
            control.on_update(lambda _: self._choose())
        self._frame.on_update(lambda _: self.show())

    def _choose(self) -> None:
        with self._lock:
            chosen = {}
            if self._sequence.value != _ALL:
                chosen["sequence"] = int(self._sequence.value.partition(":")[0])
            if self._object.value != _ALL:
                chosen["object_name"] = self._object.value
            if self._phase.value != _ALL:
                chosen["phase"] = self._phase.value
            if self._reason.value != _ALL:
                chosen["reason"] = self._reasons[self._reason.value]
            self._rows = self.view.choose(**chosen)
            self._show_choice()
            self._frame.max = _slider_end(self._rows)
            self._frame.value = 0
            self.show()

    def _show_choice(self) -> None:
        reasons = [self.view.reason[row] for row in self._rows]
        self._bar.content = bar(reasons)
        self._legend.content = legend(reasons, GOOD[self.view.kind])

    def _step(self, by: int) -> None:
        with self._lock:
            if len(self._rows):  # setting the slider calls show, as if the user had moved it
                self._frame.value = (self._frame.value + by) % len(self._rows)


def _slider_end(rows: np.ndarray) -> int:
    return max(len(rows) - 1, 1)  # a slider needs some length


class _Scene:
    """The meshes and points on the page."""

    def __init__(self, view: View, server: Any) -> None:
        self._view = view
        camera = Camera()
        server.initial_camera.position = camera.eye
        server.initial_camera.look_at = camera.target
        server.initial_camera.fov = camera.fov
        scene = server.scene
        scene.set_up_direction("+z")
        table = TableSpec()
        size = tuple(2 * half for half in table.half_size)
        scene.add_box("/table", rgb(TABLE_COLORS[0]), size, position=(*table.center, -table.half_size[2]))
        self._objects = []
        self._goals = []
        for spec in view.objects:
            mesh = (spec.vertices, spec.faces)
            body = scene.add_mesh_simple(f"/object/{spec.name}", *mesh, color=rgb(OBJECT_COLOR))
            goal = scene.add_mesh_simple(
                f"/goal/{spec.name}", *mesh, color=rgb(GOAL_COLOR), opacity=0.35, cast_shadow=False
            )
            self._objects.append(body)
            self._goals.append(goal)
        self._links: dict[int, Any] = {}
        self._colors: list[Color] = []
        self._reason = ""
        if view.robot is not None:
            self._kinematics = Kinematics(view.robot)
            self._colors = link_colors(view.robot)
            for i, mesh in enumerate(link_meshes(view.robot)):
                if mesh is not None:
                    name = f"/robot/{self._kinematics.link_names[i]}"
                    self._links[i] = scene.add_mesh_simple(
                        name, mesh.vertices, mesh.faces, color=rgb(self._colors[i]), flat_shading=False
                    )

        def add_points(name: str, color: Color, size: float) -> Any:
            nowhere = np.zeros((1, 3), dtype=np.float32)
            options = {"point_size": size, "point_shape": "circle", "precision": "float32"}
            return scene.add_point_cloud(name, nowhere, rgb(color), **options)

        self._keypoints = add_points("/human/keypoints", HUMAN_COLOR, 0.012)
        self._contacts = add_points("/human/contacts", CONTACT_COLOR, 0.006)
        self._tips = add_points("/robot/fingertips", REACHED_COLOR, 0.008)
        no_bones = np.zeros((len(BONES), 2, 3), np.float32)
        self._bones = scene.add_line_segments("/human/bones", no_bones, rgb(HUMAN_COLOR), thickness=0.003)

    def show(self, row: int | None) -> None:
        """Place everything as in a row; None hides what moves."""
        view = self._view
        shown = -1 if row is None else int(view.object_index[row])
        for i, (body, goal) in enumerate(zip(self._objects, self._goals, strict=True)):
            body.visible = i == shown
            goal.visible = i == shown
        for link in self._links.values():
            link.visible = row is not None
        self._tips.visible = row is not None and view.fingertips is not None
        self._show_human(row)
        if row is None:
            return
        sequence = view.sequence[row]
        self._objects[shown].position = view.object_pos[row]
        self._objects[shown].wxyz = view.object_quat[row]
        self._goals[shown].position = view.goal_pos[sequence]
        self._goals[shown].wxyz = view.goal_quat[sequence]
        if view.fingertips is not None:
            self._tips.points = view.fingertips[row].astype(np.float32)
        if view.joint_pos is not None:
            self._place_robot(view.joint_pos[row], view.reason[row])

    def _show_human(self, row: int | None) -> None:
        human = self._view.human
        visible = row is not None and human is not None and np.isfinite(human.keypoints[row]).all()
        self._keypoints.visible = visible
        self._bones.visible = visible
        self._contacts.visible = False
        if human is None or not visible:
            return
        keypoints = human.keypoints[row].astype(np.float32)
        touching = human.touching[row]
        colors = np.where(touching[:, None], rgb(TOUCH_COLOR), rgb(HUMAN_COLOR))
        self._keypoints.points = keypoints
        self._keypoints.colors = colors.astype(np.uint8)
        self._bones.points = keypoints[BONES]
        if touching.any():
            self._contacts.visible = True
            self._contacts.points = human.contacts[row][touching].astype(np.float32)

    def _place_robot(self, joint_pos: np.ndarray, reason: str) -> None:
        poses = self._kinematics.link_poses(torch.as_tensor(joint_pos, dtype=torch.float64))
        quats = matrix_to_quat(poses[:, :3, :3]).numpy()
        for i, link in self._links.items():
            link.position = poses[i, :3, 3].numpy()
            link.wxyz = quats[i]
            if reason != self._reason:
                color = self._colors[i]
                link.color = rgb(tint(color, reason_color(reason)) if reason else color)
        self._reason = reason


@contextmanager
def _own_page_only(host: str) -> Iterator[list[str]]:
    """Make servers that viser starts in this block answer requests of their own pages only.

    A page of another site may open a socket to any address, and a foreign name may point to this machine. viser checks
    neither and has no option for it, so the function that starts its server is replaced. The block's value lists the
    servers that are
    restricted: none if viser starts its server in another way.
    """
    from websockets.asyncio import server

    serve = server.serve
    guarded = []

    def guarded_serve(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            try:
                own = is_own_page(request.headers.get("Host", ""), request.headers.get("Origin"), host)
            except Exception:  # several headers of one name, or a damaged address
                own = False
            if not own:
                return connection.respond(403, "this server answers its own page only\n")
            return process_request(connection, request) if process_request else None

        guarded.append(host)
        return serve(*arguments, process_request=check, **options)

    server.serve = guarded_serve
    try:
        yield guarded
    finally:
        server.serve = serve


def is_own_page(host: str, origin: str | None, served: str) -> bool:
    """Whether a request comes from the page itself.

    Args:
        host: the header ``Host``: an address, which no foreign name can hide behind, or this machine's name.
        origin: the header ``Origin``, which a browser sends with a socket; None without a browser.
        served: the address that the server listens at.
    """
    name = urlsplit(f"//{host}").hostname or ""
    try:
        ip_address(name)
    except ValueError:
        if name not in ("localhost", served, gethostname(), getfqdn()):
            return False
    return origin is None or origin in (f"http://{host}", f"https://{host}")
