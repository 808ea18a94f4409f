"""A headless Chromium that a test drives over its own protocol (CDP)."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import time
from contextlib import contextmanager

import pytest
from support.faults.injected import wait_for

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
#: WebGL without a GPU.
DRAWING = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
#: What the software renderer and three.js say of themselves.
HARMLESS = ("GPU stall due to ReadPixels", "software WebGL", "THREE.Clock: This module")


class Page:
    """One tab, and all that its console said that is no information."""

    def __init__(self, socket):
        self._socket, self._count, self.messages = socket, 0, []
        self.requests = []
        for domain in ("Runtime", "Log", "Page", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method, **params):
        self._count += 1
        message = {"id": self._count, "method": method, "params": params}
        self._socket.send(json.dumps(message))
        while True:
            message = json.loads(self._socket.recv(timeout=120))
            self._note(message)
            if message.get("id") == self._count:
                assert "error" not in message, message
                return message["result"]

    def _note(self, message):
        method, params = message.get("method"), message.get("params", {})
        if method == "Runtime.exceptionThrown":
            self.messages.append(str(params["exceptionDetails"]))
        elif method == "Runtime.consoleAPICalled":
            if params["type"] in ("error", "warning", "assert"):
                self.messages.append(
                    " ".join(str(x.get("value")) for x in params["args"])
                )
        elif method == "Log.entryAdded":
            if params["entry"]["level"] in ("error", "warning"):
                self.messages.append(params["entry"]["text"])
        elif method == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"])
        self.messages = [x for x in self.messages if not any(h in x for h in HARMLESS)]

    def ask(self, script):
        reply = self.call(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in reply, reply
        return reply["result"].get("value")

    def wait(self, script):
        """Wait until JavaScript gives something true, and return it."""
        return self.until(lambda: self.ask(script), script)

    def until(self, condition, event):
        """Wait until something holds; drawing without a GPU takes its time."""
        end = time.monotonic() + 240
        while not (value := condition()):
            assert time.monotonic() < end, f"{event} came to nothing: {self.messages}"
            time.sleep(0.2)
        return value

    def go(self, address):
        self.call("Page.navigate", url=address)

    def resize(self, width, height):
        """Give the page so many pixels, whatever the window has."""
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1}
        self.call("Emulation.setDeviceMetricsOverride", mobile=False, **metrics)

    def shot(self, path):
        data = self.call("Page.captureScreenshot", format="png")["data"]
        path.write_bytes(base64.b64decode(data))


def chromium():
    """Return the browser's program; skips where there is none."""
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        pytest.skip("needs Chromium on the path")
    return program


@contextmanager
def browser(folder, size=(1400, 900)):
    from websockets.sync.client import connect

    program = chromium()
    profile = folder / "profile"
    words = [
        *("--headless", "--remote-debugging-port=0", "--no-first-run", *DRAWING),
        *([] if os.geteuid() else ["--no-sandbox"]),
        *(f"--user-data-dir={profile}", f"--window-size={size[0]},{size[1]}"),
    ]
    child = subprocess.Popen(
        [program, *words, "about:blank"], stderr=subprocess.DEVNULL
    )
    try:
        tab = _tab(_port(profile / "DevToolsActivePort"))
        with connect(tab, max_size=None, proxy=None, ping_interval=None) as socket:
            yield Page(socket)
    finally:
        child.terminate()
        child.wait(timeout=30)


def _port(path):
    """Return the browser's port, when its file is there and its first line complete."""
    wait_for(lambda: path.exists() and "\n" in path.read_text())
    return path.read_text().split()[0]


def _tab(port):
    from urllib.request import urlopen

    with urlopen(f"http://127.0.0.1:{port}/json/list", timeout=30) as answer:
        tabs = json.load(answer)
    return next(x for x in tabs if x["type"] == "page")["webSocketDebuggerUrl"]
