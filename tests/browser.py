"""A headless Chromium that tests drive through its DevTools protocol."""

import base64
import io
import itertools
import json
import shutil
import subprocess
import tempfile
import time
import urllib.request
from pathlib import Path
from unittest import SkipTest

import numpy as np
from PIL import Image
from websockets.sync.client import connect

_NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
_FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-extensions",
    "--mute-audio", "--hide-scrollbars",
    "--enable-unsafe-swiftshader",  # WebGL without a GPU
    "--remote-debugging-port=0", "--window-size=640,600",
)  # fmt: skip
INPUT = "document.getElementById([...document.querySelectorAll('label')].find(e => e.textContent === '{label}').htmlFor)"
"""Control of a page of viser, by its label."""
_BUTTON = "[...document.querySelectorAll('button')].find(e => e.textContent === '{label}')"
_OPTION = "[...document.querySelectorAll('[role=option]')].find(e => e.textContent === '{label}' && e.offsetParent)"
_KEYS = {"ArrowRight": 39, "End": 35}


def find_chromium():
    """The browser's program; skips the test where there is none."""
    program = next(filter(None, map(shutil.which, _NAMES)), None)
    if program is None:
        raise SkipTest(f"no Chromium here (looked for {', '.join(_NAMES)})")
    return program


class Browser:
    """One tab. ``problems`` collects console errors and exceptions of its pages."""

    def __init__(self, program):
        self.problems: list[str] = []
        self._profile = tempfile.TemporaryDirectory(
            prefix="xreset-chromium-", ignore_cleanup_errors=True
        )
        self._process = subprocess.Popen(
            [program, *_FLAGS, f"--user-data-dir={self._profile.name}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        port_file = Path(self._profile.name) / "DevToolsActivePort"
        wait_until(
            lambda: port_file.is_file() and "\n" in port_file.read_text(),
            "Chromium to start",
            seconds=60,
        )
        port = port_file.read_text().split()[0]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list", timeout=20) as answer:
            tab = next(target for target in json.load(answer) if target["type"] == "page")
        self._socket = connect(tab["webSocketDebuggerUrl"], max_size=2**27, open_timeout=20)
        self._number = itertools.count(1)
        for domain in ("Page", "Runtime", "Log"):
            self.send(f"{domain}.enable")

    def close(self):
        self._socket.close()
        self._process.terminate()
        try:
            self._process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._profile.cleanup()

    def send(self, method, **params):
        """One command and its answer; what the page reports meanwhile is looked through for problems."""
        number = next(self._number)
        self._socket.send(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            message = json.loads(self._socket.recv(timeout=60))
            if message.get("id") == number:
                if "error" in message:
                    raise AssertionError(f"{method}: {message['error']['message']}")
                return message["result"]
            self._note(message.get("method"), message.get("params", {}))

    def _note(self, event, params):
        if event == "Runtime.exceptionThrown":
            self.problems.append(json.dumps(params["exceptionDetails"])[:500])
        elif event == "Runtime.consoleAPICalled" and params["type"] in ("error", "assert"):
            self.problems.append(
                " ".join(str(arg.get("value", arg.get("description"))) for arg in params["args"])[
                    :500
                ]
            )
        elif event == "Log.entryAdded" and params["entry"]["level"] == "error":
            self.problems.append(f"{params['entry']['text']} ({params['entry'].get('url')})")

    def open(self, url):
        self.send("Page.navigate", url=url)

    def evaluate(self, expression):
        result = self.send(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        if "exceptionDetails" in result:
            raise AssertionError(f"{expression}: {result['exceptionDetails']}")
        return result["result"].get("value")

    def key(self, name):
        """Press a key where the focus is."""
        for kind in ("rawKeyDown", "keyUp"):
            self.send(
                "Input.dispatchKeyEvent",
                type=kind,
                key=name,
                code=name,
                windowsVirtualKeyCode=_KEYS[name],
            )

    def click(self, element):
        """Click the middle of a JavaScript expression's element, once it stays where it is and nothing covers it."""
        at = (
            f"(e => {{ e.scrollIntoView({{block: 'center'}}); const r = e.getBoundingClientRect();"
            " const x = r.x + r.width / 2, y = r.y + r.height / 2, top = document.elementFromPoint(x, y);"
            f" return [x, y, !!top && (e.contains(top) || top.contains(e))]; }})({element})"
        )

        def still():
            try:
                first = self.evaluate(at)
            except AssertionError:  # not there yet
                return None
            time.sleep(0.1)
            return first if first[2] and self.evaluate(at) == first else None

        x, y, _ = wait_until(still, f"{element} to stay where it is")
        for kind in ("mousePressed", "mouseReleased"):
            self.send(
                "Input.dispatchMouseEvent",
                type=kind,
                x=x,
                y=y,
                button="left",
                buttons=1,
                clickCount=1,
            )

    def press(self, button):
        """Click a button of viser."""
        self.click(_BUTTON.format(label=button))

    def choose(self, label, option):
        """Open a drop-down of viser and click one of its options."""
        self.click(INPUT.format(label=label))
        self.click(_OPTION.format(label=option))

    def text(self):
        """The text of the page."""
        return self.evaluate("document.body?.innerText ?? ''")

    def drag(self, start, end, steps=5):
        """Move the mouse to a point, press it, and release it at another one, in pixels."""
        mouse = {"button": "left", "buttons": 1, "clickCount": 1}
        self.send("Input.dispatchMouseEvent", type="mouseMoved", x=start[0], y=start[1])
        time.sleep(0.2)
        self.send("Input.dispatchMouseEvent", type="mousePressed", x=start[0], y=start[1], **mouse)
        for i in range(1, steps + 1):
            x, y = (a + (b - a) * i / steps for a, b in zip(start, end, strict=True))
            self.send(
                "Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y, button="left", buttons=1
            )
            time.sleep(0.2)
        self.send("Input.dispatchMouseEvent", type="mouseReleased", x=end[0], y=end[1], **mouse)

    def resize(self, width, height, *, phone=False):
        """Give the page a size [pixels]."""
        self.send(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=phone,
        )

    def pixels(self):
        """The page as a picture, [height, width, 3] integers."""
        png = base64.b64decode(self.send("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)


def wait_until(condition, what, seconds=20.0):
    """Wait until a condition holds and return what it gave; ``AssertionError`` if it does not in time."""
    end = time.monotonic() + seconds
    while not (value := condition()):
        if time.monotonic() > end:
            raise AssertionError(f"waited {seconds:g} s for {what}")
        time.sleep(0.05)
    return value
