"""Chromium without a window, spoken to through its DevTools, for what only a browser can show."""

import base64
import io
import json
import shutil
import subprocess
import urllib.request
from contextlib import contextmanager

import numpy as np
from PIL import Image

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "chrome"))), None)

_FLAGS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-sync "
    "--disable-background-networking --disable-component-update --use-angle=swiftshader "
    "--enable-unsafe-swiftshader --remote-debugging-port=0"
).split()


class Tab:
    """The one open page."""

    def __init__(self, connection):
        self._connection, self._count = connection, 0

    def call(self, method, **parameters):
        """Result of a DevTools call."""
        self._count += 1
        asked = {"id": self._count, "method": method, "params": parameters}
        self._connection.send(json.dumps(asked))
        while True:
            told = json.loads(self._connection.recv(timeout=120))
            if told.get("id") == self._count:
                return told["result"]

    def text(self):
        """All words on the page."""
        return self.run("document.body ? document.body.innerText : ''")  # a new page has none yet

    def run(self, script):
        """What a line of the browser's language gives."""
        return self.call("Runtime.evaluate", expression=script)["result"].get("value")

    def click(self, words):
        """Click the button with these words."""
        button = f"[...document.querySelectorAll('button,label')].find(b => b.innerText=='{words}')"
        assert self.run(f"(b => b ? (b.click(), true) : false)({button})"), f"no button {words}"

    def fill(self, label, text):
        """Type into the last field of the row whose label begins with a word."""
        rows = "[...document.querySelectorAll('label')]"
        rows += f".filter(l => l.innerText.startsWith('{label}'))"
        up = "while (l && !l.querySelector('input')) l = l.parentElement"
        last = (
            "const f = [...l.querySelectorAll('input')].pop(); f.focus(); f.select(); return true"
        )
        assert self.run(f"(l => {{ {up}; {last} }})({rows}[0])"), f"no field {label}"
        self.call("Input.insertText", text=text)
        for kind in ("keyDown", "keyUp"):
            enter = {"key": "Enter", "code": "Enter", "windowsVirtualKeyCode": 13}
            self.call("Input.dispatchKeyEvent", type=kind, **enter)

    def picture(self):
        """What is seen, (height, width, 3)."""
        png = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))


@contextmanager
def opened(address, profile, height=800):
    """A page in a browser of its own, 1200 pixels wide, with a profile in an empty folder."""
    from websockets.sync.client import connect  # comes with viser

    size = f"--window-size=1200,{height}"
    command = [CHROMIUM, *_FLAGS, size, f"--user-data-dir={profile}", address]
    browser = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        told = next(line for line in browser.stderr if "DevTools listening on" in line)
        port = told.split(":")[-1].split("/")[0]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
            tabs = [tab for tab in json.load(answer) if tab["type"] == "page"]
        with connect(tabs[0]["webSocketDebuggerUrl"], max_size=None) as connection:
            yield Tab(connection)
    finally:
        browser.terminate()
        browser.wait()
