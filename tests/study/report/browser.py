"""A headless Chromium, driven over a pipe by its own protocol: what a page does, says and looks like."""

import base64
import contextlib
import fcntl
import json
import os
import shutil
import signal
import tempfile
from pathlib import Path

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome", "chrome-headless-shell", "headless_shell")


def find_chromium():
    """A Chromium on this machine, or None: $CHROMIUM, on the PATH, Playwright's, or in the temporary folder."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ms-playwright"
    places = [os.environ.get("CHROMIUM"), *map(shutil.which, NAMES)]
    places += [*sorted(cache.glob("chromium*/*/*")), *(Path(tempfile.gettempdir()) / name for name in NAMES)]
    usable = (Path(p) for p in places if p and (Path(p).name in NAMES or p == places[0]))
    return next((str(p) for p in usable if p.is_file() and os.access(p, os.X_OK)), None)


def _closed(pipe):
    """The ends of a pipe, one after another, each closed once it has been used."""
    for end in pipe:
        yield end
        os.close(end)


class Page:
    """One page in a browser of its own; `close` ends both."""

    def __init__(self, path, folder):
        options = ["--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-pipe", "--no-first-run"]
        options += [f"--user-data-dir={folder}", "--hide-scrollbars", "about:blank"]
        # Chromium reads its commands from descriptor 3 and writes to 4; ours are moved out of their way first.
        ends = [fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 10) for pipe in (os.pipe(), os.pipe()) for end in _closed(pipe)]
        moves = [(os.POSIX_SPAWN_DUP2, ends[0], 3), (os.POSIX_SPAWN_DUP2, ends[3], 4)]
        moves += [(os.POSIX_SPAWN_OPEN, place, os.devnull, os.O_WRONLY, 0) for place in (1, 2)]
        self._process = os.posix_spawn(path, [path, *options], os.environ, file_actions=moves)
        self._from, self._to = os.fdopen(ends[2], "rb"), os.fdopen(ends[1], "wb", buffering=0)
        for end in (ends[0], ends[3]):
            os.close(end)
        self._count, self._session, self.events = 0, None, []
        try:
            target = self.call("Target.createTarget", url="about:blank")["targetId"]
            self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
            for domain in ("Page", "Runtime", "Log", "Network"):
                self.call(f"{domain}.enable")
        except BaseException:
            self.close()
            raise

    def _read(self):
        message = bytearray()
        while (byte := self._from.read(1)) != b"\0":
            assert byte, "the browser is gone"
            message += byte
        return json.loads(message)

    def call(self, method, **parameters):
        self._count += 1
        session = {} if self._session is None else {"sessionId": self._session}
        message = {"id": self._count, "method": method, "params": parameters} | session
        self._to.write(json.dumps(message).encode() + b"\0")
        while (answer := self._read()).get("id") != self._count:
            self.events.append(answer)
        assert "error" not in answer, answer
        return answer["result"]

    def open(self, path, width=1200, height=900, touch=False):
        self.events.clear()
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": touch}
        self.call("Emulation.setDeviceMetricsOverride", **size)
        self.call("Emulation.setTouchEmulationEnabled", enabled=touch)
        self.call("Page.navigate", url=path.resolve().as_uri())
        while not any(event["method"] == "Page.loadEventFired" for event in self.events):
            self.events.append(self._read())

    def value(self, expression):
        """What a JavaScript expression gives; a promise is waited for."""
        how = {"returnByValue": True, "awaitPromise": True}
        found = self.call("Runtime.evaluate", expression=expression, **how)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def settle(self):
        """Wait until what was asked for is drawn."""
        self.value("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")

    def complaints(self):
        """Errors and warnings: of scripts, of the page's policy, of what could not be loaded."""
        said = ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded")
        return [event["params"] for event in self.events if event["method"] in said]

    def requested(self):
        """Addresses that were asked for."""
        sent = (event["params"] for event in self.events if event["method"] == "Network.requestWillBeSent")
        return [each["request"]["url"] for each in sent]

    def mouse(self, kind, x, y, held=False, clicks=1):
        button = {} if kind == "mouseMoved" else {"button": "left", "clickCount": clicks}
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, buttons=int(held), **button)

    def drag(self, start, end):
        self.mouse("mousePressed", *start, held=True)
        self.mouse("mouseMoved", *end, held=True)
        self.mouse("mouseReleased", *end)

    def double_click(self, x, y):
        for clicks in (1, 2):
            self.mouse("mousePressed", x, y, held=True, clicks=clicks)
            self.mouse("mouseReleased", x, y, clicks=clicks)

    def touch_drag(self, start, end):
        points = [[{"x": x, "y": y}] for x, y in (start, ((start[0] + end[0]) / 2, start[1]), end)]
        for kind, where in zip(("touchStart", "touchMove", "touchMove", "touchEnd"), [*points, []], strict=True):
            self.call("Input.dispatchTouchEvent", type=kind, touchPoints=where)

    def screenshot(self, path, **options):
        data = self.call("Page.captureScreenshot", captureBeyondViewport=True, **options)["data"]
        path.write_bytes(base64.b64decode(data))

    def close(self):
        with contextlib.suppress(OSError):
            os.kill(self._process, signal.SIGTERM)
        os.waitpid(self._process, 0)
        self._to.close()
        self._from.close()
