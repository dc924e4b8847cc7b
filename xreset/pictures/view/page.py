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
from xreset.pictures.meshes import GOAL_COLOR, OBJECT_COLOR, TABLE_COLORS, link_colors, link_meshes, tinted
from xreset.pictures.raster import Camera
from xreset.pictures.view.colors import CONTACT_COLOR, HUMAN_COLOR, REACHED_COLOR, TOUCH_COLOR, reason_color
from xreset.pictures.view.data import BONES, GOOD, PHASES, View
from xreset.pictures.view.timeline import bar, legend, mark
from xreset.spec import TableSpec

_ALL = "all"
_IDLE = 0.1
"""[s] between looks at whether something is to be played."""


class Page:
    """A page at :attr:`url` until :meth:`close`. Everyone who opens it sees, and turns, the same controls."""

    def __init__(
        self, view: View, *, host: str = "127.0.0.1", port: int = 8080, sequence: int | None = None, frame: int = 0
    ) -> None:
        """Start the server.

        Args:
            host: address to listen at; 0.0.0.0 for every one that the machine has.
            port: port to listen at; the next free one if it is taken.
            sequence: the sequence to begin with; None: all of a bank, the first of another file.
            frame: the row of that choice to begin with.

        Raises:
            XResetError: viser is not installed, the server does not start, or there is no such sequence or frame.
        """
        with needs("viser, without which --png and --mp4 work,", "viewer"):
            import viser
        self.view = view
        sequence = 0 if sequence is None and view.kind != "reset states" else sequence
        self._rows = view.choose(sequence=sequence)
        if not 0 <= frame < len(self._rows):
            raise XResetError(f"there is no frame {frame}; the sequence has {len(self._rows)}, counted from 0.")
        self._lock = threading.RLock()
        try:
            with _own_page_only(host):
                self._server = viser.ViserServer(host=host, port=port, label="xreset view", verbose=False)
        except OSError as error:
            raise XResetError(
                f"the page cannot be served at {host}:{port}: {error}. Choose others with --host and --port."
            ) from error
        self._scene = _Scene(view, self._server)
        self._make_controls(sequence)
        self._show_choice()
        self._frame.value = frame
        self.show()

    @property
    def url(self) -> str:
        """Where the page is, seen from this machine."""
        host = self._server.get_host()
        return f"http://{'localhost' if host in ('0.0.0.0', '127.0.0.1') else host}:{self._server.get_port()}"

    @property
    def row(self) -> int | None:
        """The row that is shown; None if the controls leave none."""
        return int(self._rows[min(int(self._frame.value), len(self._rows) - 1)]) if len(self._rows) else None

    def show(self) -> None:
        """Bring the scene and the text to what the controls say."""
        with self._lock, self._server.atomic():
            row = self.row
            self._scene.show(row)
            self._mark.content = "" if row is None else mark(int(self._frame.value), len(self._rows))
            if row is None:
                self._text.content = "nothing meets this choice"
                return
            first, *others = self.view.text(row)
            self._text.content = "\n\n".join(
                (f"**{first}**", *others, f"{int(self._frame.value) + 1} of {len(self._rows)}")
            )

    def serve(self) -> None:
        """Play what is to be played, until interrupted."""
        while True:
            if not self._play.value or len(self._rows) < 2:
                time.sleep(_IDLE)
                continue
            time.sleep(1.0 / (self.view.rate * self._speed.value))
            with self._lock:
                self._frame.value = (int(self._frame.value) + 1) % len(
                    self._rows
                )  # calls show, as if the user had moved it

    def close(self) -> None:
        """Stop the server."""
        self._server.stop()

    def _make_controls(self, sequence: int | None) -> None:
        gui, view = self._server.gui, self.view
        self._reason_of = {
            f"{reason or GOOD[view.kind]} ({count})": reason for reason, count in view.counts().items() if count
        }
        names = [f"{s}: {name}" for s, name in enumerate(view.sequence_name)]
        first = _ALL if sequence is None else names[sequence]
        self._sequence: Any = gui.add_dropdown("sequence", [_ALL, *names], initial_value=first)
        self._object: Any = gui.add_dropdown(
            "object", [_ALL, *(spec.name for spec in view.objects)], initial_value=_ALL
        )
        self._phase: Any = gui.add_dropdown("phase", [_ALL, *PHASES], initial_value=_ALL)
        self._reason: Any = gui.add_dropdown(
            "state", [_ALL, *self._reason_of], initial_value=_ALL, visible=bool(view.reasons)
        )
        self._frame: Any = gui.add_slider(
            "number" if view.kind == "reset states" else "frame", 0, max(len(self._rows) - 1, 1), 1, 0
        )
        back, on = gui.add_button("previous"), gui.add_button("next")
        self._play: Any = gui.add_checkbox("play", False)
        self._speed: Any = gui.add_slider("speed", 0.1, 2.0, 0.1, 1.0)
        self._bar: Any = gui.add_html("")
        self._mark: Any = gui.add_html("")
        self._legend: Any = gui.add_html("")
        self._text: Any = gui.add_markdown("")
        for control in (self._sequence, self._object, self._phase, self._reason):
            control.on_update(lambda _: self._choose())
        self._frame.on_update(lambda _: self.show())
        back.on_click(lambda _: self._step(-1))
        on.on_click(lambda _: self._step(1))

    def _choose(self) -> None:
        with self._lock:
            sequence, name, phase = self._sequence.value, self._object.value, self._phase.value
            self._rows = self.view.choose(
                sequence=None if sequence == _ALL else int(sequence.partition(":")[0]),
                object_name=None if name == _ALL else name,
                phase=None if phase == _ALL else phase,
                reason=None if self._reason.value == _ALL else self._reason_of[self._reason.value],
            )
            self._show_choice()
            self._frame.max = max(len(self._rows) - 1, 1)  # a slider needs some length
            self._frame.value = 0
            self.show()

    def _show_choice(self) -> None:
        reasons = [self.view.reason[row] for row in self._rows]
        self._bar.content, self._legend.content = bar(reasons), legend(reasons, GOOD[self.view.kind])

    def _step(self, by: int) -> None:
        with self._lock:
            if len(self._rows):
                self._frame.value = (int(self._frame.value) + by) % len(self._rows)


class _Scene:
    """The meshes and points on the page."""

    def __init__(self, view: View, server: Any) -> None:
        self._view, scene = view, server.scene
        camera, table = Camera(), TableSpec()
        server.initial_camera.position, server.initial_camera.look_at = camera.eye, camera.target
        server.initial_camera.fov = camera.fov
        scene.set_up_direction("+z")
        scene.add_box(
            "/table",
            _rgb(TABLE_COLORS[0]),
            tuple(2 * h for h in table.half_size),
            position=(*table.center, -table.half_size[2]),
        )
        self._objects = [
            scene.add_mesh_simple(f"/object/{o.name}", o.vertices, o.faces, color=_rgb(OBJECT_COLOR))
            for o in view.objects
        ]
        self._goals = [
            scene.add_mesh_simple(
                f"/goal/{o.name}", o.vertices, o.faces, color=_rgb(GOAL_COLOR), opacity=0.35, cast_shadow=False
            )
            for o in view.objects
        ]
        self._links: dict[int, Any] = {}
        self._colors: list[Any] = []
        self._reason = ""
        if view.robot is not None:
            self._kinematics = Kinematics(view.robot)
            self._colors = link_colors(view.robot)
            for i, (name, mesh) in enumerate(zip(self._kinematics.link_names, link_meshes(view.robot), strict=True)):
                if mesh is not None:
                    self._links[i] = scene.add_mesh_simple(
                        f"/robot/{name}", mesh.vertices, mesh.faces, color=_rgb(self._colors[i]), flat_shading=False
                    )
        nowhere = np.zeros((1, 3), dtype=np.float32)
        points = {"point_shape": "circle", "precision": "float32"}
        self._keypoints = scene.add_point_cloud(
            "/human/keypoints", nowhere, _rgb(HUMAN_COLOR), point_size=0.012, **points
        )
        self._bones = scene.add_line_segments(
            "/human/bones", np.zeros((20, 2, 3), np.float32), _rgb(HUMAN_COLOR), thickness=0.003
        )
        self._contacts = scene.add_point_cloud(
            "/human/contacts", nowhere, _rgb(CONTACT_COLOR), point_size=0.006, **points
        )
        self._tips = scene.add_point_cloud(
            "/robot/fingertips", nowhere, _rgb(REACHED_COLOR), point_size=0.008, **points
        )

    def show(self, row: int | None) -> None:
        """Place everything as in a row; None hides what moves."""
        view = self._view
        for i, (body, goal) in enumerate(zip(self._objects, self._goals, strict=True)):
            body.visible = goal.visible = row is not None and i == view.object_index[row]
        human = (
            view.human
            if row is not None and view.human is not None and np.isfinite(view.human.keypoints[row]).all()
            else None
        )
        self._keypoints.visible = self._bones.visible = human is not None
        self._contacts.visible = human is not None and bool(human.touching[row].any())
        self._tips.visible = row is not None and view.fingertips is not None
        for link in self._links.values():
            link.visible = row is not None
        if row is None:
            return
        i, sequence = view.object_index[row], view.sequence[row]
        self._objects[i].position, self._objects[i].wxyz = view.object_pos[row], view.object_quat[row]
        self._goals[i].position, self._goals[i].wxyz = view.goal_pos[sequence], view.goal_quat[sequence]
        if human is not None:
            self._keypoints.points = human.keypoints[row].astype(np.float32)
            self._keypoints.colors = np.where(
                human.touching[row][:, None], _rgb(TOUCH_COLOR), _rgb(HUMAN_COLOR)
            ).astype(np.uint8)
            self._bones.points = human.keypoints[row][BONES].astype(np.float32)
            if self._contacts.visible:
                self._contacts.points = human.contacts[row][human.touching[row]].astype(np.float32)
        if view.fingertips is not None:
            self._tips.points = view.fingertips[row].astype(np.float32)
        if view.joint_pos is not None:
            self._place_robot(view.joint_pos[row], view.reason[row])

    def _place_robot(self, joint_pos: np.ndarray, reason: str) -> None:
        poses = self._kinematics.link_poses(torch.as_tensor(joint_pos, dtype=torch.float64))
        quats = matrix_to_quat(poses[:, :3, :3]).numpy()
        for i, link in self._links.items():
            link.position, link.wxyz = poses[i, :3, 3].numpy(), quats[i]
            if reason != self._reason:
                link.color = _rgb(tinted(self._colors[i], reason_color(reason)) if reason else self._colors[i])
        self._reason = reason


def _rgb(color: Any) -> tuple[int, int, int]:
    """Red, green, blue in 0..255."""
    red, green, blue = (round(255 * float(part)) for part in color)
    return red, green, blue


@contextmanager
def _own_page_only(host: str) -> Iterator[None]:
    """Servers that viser starts in this block answer their own pages only: viser itself asks nobody where he comes from.

    A page of another site may open a socket to any address, and a name of its own may be made to point here.
    """
    from websockets.asyncio import server

    serve = server.serve

    def guarded(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            if not is_own_page(request.headers.get("Host", ""), request.headers.get("Origin"), host):
                return connection.respond(403, "this server answers its own page only\n")
            return process_request(connection, request) if process_request else None

        return serve(*arguments, process_request=check, **options)

    server.serve = guarded
    try:
        yield
    finally:
        server.serve = serve


def is_own_page(host: str, origin: str | None, served: str) -> bool:
    """Whether a request comes from the page itself.

    Args:
        host: the header ``Host``: an address, which no foreign name can hide behind, or this machine's name.
        origin: the header ``Origin``, which a browser sends with a socket; None without a browser.
        served: the address that is listened at.
    """
    name = urlsplit(f"//{host}").hostname or ""
    try:
        ip_address(name)
    except ValueError:
        if name not in ("localhost", served, gethostname(), getfqdn()):
            return False
    return origin is None or origin in (f"http://{host}", f"https://{host}")
