"""The web server of a page, restricted to that page, and what every page shows: the table and the robot."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from html import escape
from ipaddress import ip_address
from socket import AF_INET, AF_INET6, create_server, getfqdn, gethostname
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from scipy.spatial.transform import Rotation

from xreset.errors import XResetError, needs
from xreset.files.text import plain
from xreset.geometry.kinematics import on_host
from xreset.geometry.shapes import quat_of
from xreset.geometry.urdf import link_meshes
from xreset.pictures.meshes import TABLE_COLORS, Color, link_colors, rgb, tint
from xreset.pictures.render import Camera
from xreset.spec import RobotSpec, TableSpec

_LOG = logging.getLogger("xreset")
IDLE = 0.1
"""Time between two looks at the controls [s]."""


_ROOM = np.array((0.0, 0.0, 0.3))
"""How far above the middle of a phone's picture the scene is [m]."""


class WebPage:
    """A page at :attr:`url` until :meth:`close`. It shows the table, and answers its own visitors only."""

    def __init__(self, host: str, port: int, label: str) -> None:
        """Start the server.

        Args:
            host: address to listen at; 0.0.0.0 for every address of the machine.
            port: port to listen at; the next free one if it is taken.
            label: title of the page.

        Raises:
            XResetError: viser is not installed, or the server does not start.
        """
        with needs("viser, without which --out of xreset view works,", "viewer"):
            import viser
        try:
            # viser waits for ever where no port of a host can be had
            family = AF_INET6 if ":" in host else AF_INET
            create_server((host, 0), family=family).close()
            with _own_page_only(host) as guarded:
                server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
        except OSError as error:
            raise XResetError(
                f"Cannot serve the page at {host}:{port}: {error}. Choose another --host or --port."
            ) from error
        if not guarded:
            server.stop()
            raise XResetError(
                "This version of viser cannot be restricted to its own page. Install viser 1.1."
            )
        camera = Camera()
        server.initial_camera.position = camera.eye
        server.initial_camera.look_at = camera.target
        server.initial_camera.fov = camera.fov
        server.scene.set_up_direction("+z")
        table = TableSpec()
        size = 2 * np.array(table.half_size)
        server.scene.add_box(
            "/table", rgb(TABLE_COLORS[0]), size, position=(*table.center, -table.half_size[2])
        )
        server.on_client_connect(self._make_room)
        self._server = server

    def _make_room(self, client: Any) -> None:
        """Move the scene of a phone up, because the controls cover its lower part."""
        if client.camera.aspect < 1.0:
            camera = self._server.initial_camera
            look_at = np.asarray(camera.look_at)
            below = look_at - _ROOM
            client.camera.position = below + 1.4 * (np.asarray(camera.position) - look_at)
            client.camera.look_at = below

    @property
    def url(self) -> str:
        """Address of the page, seen from this machine."""
        host = self._server.get_host()
        if host in ("0.0.0.0", "127.0.0.1"):
            host = "localhost"
        elif ":" in host:
            host = "[::1]" if host == "::" else f"[{host}]"
        return f"http://{host}:{self._server.get_port()}"

    def serve(self) -> None:
        """Serve until interrupted. No error ends it, because a visitor may send anything."""
        last = ""
        while True:
            try:
                self.tick()
            except Exception as error:
                problem = plain(f"{type(error).__name__}: {error}")[:200]
                if problem != last:
                    _LOG.warning("A visitor's message could not be carried out. %s", problem)
                last = problem
                time.sleep(IDLE)

    def tick(self) -> None:
        """Do once what is due, and wait for the next time."""
        raise NotImplementedError

    def close(self) -> None:
        """Stop the server."""
        self._server.stop()


def chosen(dropdown: Any, otherwise: Any) -> Any:
    """Return the value of a drop-down; ``otherwise`` if a visitor has sent one that is not among its options."""
    return dropdown.value if dropdown.value in dropdown.options else otherwise


def bounded(slider: Any) -> Any:
    """Return the value of a slider; its least value if a visitor has sent one that is outside."""
    return slider.value if slider.min <= slider.value <= slider.max else slider.min


def as_html(first: str, *others: str) -> str:
    """Return paragraphs for ``gui.add_html`` that show the texts, which may be from a file, as they are.

    viser's Markdown would run the scripts in them. The first paragraph is bold.
    """
    paragraphs = [f"<b>{escape(first)}</b>", *map(escape, others)]
    lines = [f'<p style="margin: 0 0 0.6em">{paragraph}</p>' for paragraph in paragraphs]
    style = "padding: 0 0.75em; font-size: 0.875em; overflow-wrap: anywhere"
    return f'<div style="{style}">{"".join(lines)}</div>'


def serve_until_interrupted(server: Any) -> None:
    """Serve until Ctrl-C, then close. ``server`` has the methods ``serve`` and ``close``."""
    try:
        server.serve()
    except KeyboardInterrupt:  # the way to end it, not a failure
        print("\nclosed.")
    finally:
        server.close()


class RobotMeshes:
    """The links of a robot on a page.

    Attributes:
        links: mesh on the page by name of the link; links without a shape are left out.
    """

    def __init__(self, scene: Any, robot: RobotSpec) -> None:
        """Add the meshes to a viser scene."""
        self._kinematics = on_host(robot)
        self._tint: Color | None = None
        self._colors = link_colors(robot)
        self.links: dict[str, Any] = {}
        for name, mesh in link_meshes(robot).items():
            self.links[name] = scene.add_mesh_simple(
                f"/robot/{name}",
                mesh.vertices,
                mesh.faces,
                color=rgb(self._colors[name]),
                flat_shading=False,
            )

    def place(self, joint_pos: np.ndarray, color: Color | None = None) -> None:
        """Show joint positions [J] [rad, m], with a color mixed into the robot's own."""
        poses = self._kinematics.link_poses(np.asarray(joint_pos, dtype=float), tuple(self.links))
        quats = quat_of(Rotation.from_matrix(poses[:, :3, :3]))
        for (name, link), pose, quat in zip(self.links.items(), poses, quats, strict=True):
            link.position = pose[:3, 3]
            link.wxyz = quat
            if color != self._tint:
                link.color = rgb(tint(self._colors[name], color))
        self._tint = color


@contextmanager
def _own_page_only(host: str) -> Iterator[list[str]]:
    """Make servers that viser starts in this block answer requests of their own pages only.

    A page of another site may open a socket to any address, and a foreign name may point to this machine. viser checks
    neither and has no option for it, so the function that starts its server is replaced. The block's value lists the
    servers that are restricted: none if viser starts its server in another way.
    """
    from websockets.asyncio import server

    serve = server.serve
    guarded = []

    def guarded_serve(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            try:
                own = is_own_page(
                    request.headers.get("Host", ""), request.headers.get("Origin"), host
                )
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
        own = ("localhost", served, gethostname(), getfqdn(), f"{gethostname()}.local")
        if name not in [each.lower() for each in own]:  # browsers write names in small letters
            return False
    return origin is None or origin in (f"http://{host}", f"https://{host}")
