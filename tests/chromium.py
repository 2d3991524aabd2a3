"""A headless Chromium for tests, driven by its DevTools protocol."""

import base64
import json
import re
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

PROGRAM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
_OPTIONS = (
    "--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--hide-scrollbars",
    "--remote-debugging-port=0", "--remote-allow-origins=*", "--no-first-run", "--disable-dev-shm-usage",
)  # fmt: skip
_WAIT_S = 120.0


class Page:
    """One page of the browser."""

    def __init__(self, socket):
        self._socket, self._number = socket, 0
        self._loaded: set[str] = set()
        self.said: list[str] = []
        for domain in ("Page", "Runtime", "Network"):
            self.ask(f"{domain}.enable")
        self.ask("Page.setLifecycleEventsEnabled", enabled=True)

    def open(self, url: str) -> None:
        """Show an address, and wait until it has loaded: before, Chromium may have no page to take a picture of."""
        loader = self.ask("Page.navigate", url=url)["loaderId"]
        while loader not in self._loaded:
            self._hear()

    def ask(self, method: str, **parameters):
        """The answer to a command of the protocol; what the console says meanwhile is kept in `said`."""
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            told = self._hear()
            if told.get("id") == self._number:
                if "error" in told:
                    raise RuntimeError(f"{method}: {told['error']}")
                return told["result"]

    def _hear(self) -> dict:
        """The next message of the browser; what the console says is kept in `said`, and which documents have loaded."""
        told = json.loads(self._socket.recv(timeout=_WAIT_S))
        said, told_of = told.get("method"), told.get("params", {})
        if said in ("Runtime.exceptionThrown", "Network.loadingFailed"):
            self.said.append(json.dumps(told_of)[:2000])
        if said == "Network.requestWillBeSent":
            self.said.append("request " + told_of["request"]["url"][:80])
        if said == "Page.lifecycleEvent" and told_of["name"] == "load":
            self._loaded.add(told_of["loaderId"])
        return told

    def value(self, expression: str):
        """What a JavaScript expression gives, awaited."""
        said = self.ask("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        return said["result"].get("value")

    def until(self, expression: str, seconds: float = _WAIT_S) -> None:
        """Wait until an expression is true."""
        end = time.monotonic() + seconds
        while not self.value(expression):
            if time.monotonic() > end:
                raise TimeoutError(f"{expression} has not become true in {seconds} s")
            time.sleep(0.2)

    def click_text(self, text: str) -> None:
        """Click on the innermost element that has this text, once it is there."""
        found = f"[...document.querySelectorAll('*')].filter(e => e.innerText?.trim() === {json.dumps(text)}).at(-1)"
        self.until(f"{found} !== undefined")
        self.value(f"{found}.scrollIntoView()")
        middle = "(box => [box.x + box.width / 2, box.y + box.height / 2])"
        self.click(*self.value(f"{middle}({found}.getBoundingClientRect())"))

    def drag(self, start: tuple[float, float], end: tuple[float, float], modifiers: int = 0) -> None:
        """Move from a place [px] to another with the left button down; the modifier 8 is Shift."""
        way = [tuple(a + (b - a) * part for a, b in zip(start, end, strict=True)) for part in (0.2, 0.6, 1.0)]
        kinds = ["mousePressed", *["mouseMoved"] * 3, "mouseReleased"]
        for kind, (x, y) in zip(kinds, [start, *way, end], strict=True):
            held = {"button": "left", "buttons": 1, "clickCount": 1, "modifiers": modifiers}
            self.ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, **held)

    def click(self, x: float, y: float, modifiers: int = 0) -> None:
        """Press and release the left button at a place [px]; the modifier 8 is Shift."""
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            held = {"button": "left", "clickCount": 1, "modifiers": modifiers}
            self.ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, **held)

    def press(self, key: str) -> None:
        """Press and release a key."""
        for kind in ("keyDown", "keyUp"):
            self.ask("Input.dispatchKeyEvent", type=kind, key=key)

    def screenshot(self, path: Path | None = None) -> bytes:
        """The page as PNG."""
        data = base64.b64decode(self.ask("Page.captureScreenshot", format="png")["data"])
        if path is not None:
            path.write_bytes(data)
        return data


@contextmanager
def page_at(url: str, width: int = 1000, height: int = 700) -> Iterator[Page]:
    """A page that shows an address."""
    from websockets.sync.client import connect

    with TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = [PROGRAM, *_OPTIONS, f"--window-size={width},{height}", f"--user-data-dir={profile}", "about:blank"]
        log = Path(profile) / "log"
        with log.open("wb") as stream:
            browser = subprocess.Popen(command, stderr=stream, stdout=stream)
        try:
            with connect(_page_socket(log), max_size=None, ping_interval=None) as socket:
                page = Page(socket)
                page.open(url)
                yield page
        finally:
            browser.terminate()
            browser.wait(20)


def _page_socket(log: Path) -> str:
    """The address of the first page, by what the browser says where it listens."""
    from urllib.request import urlopen

    end = time.monotonic() + _WAIT_S
    while time.monotonic() < end:
        found = re.search(r"DevTools listening on ws://([^/]+)/", log.read_text(errors="replace"))
        if found:
            with urlopen(f"http://{found[1]}/json/list") as answer:
                pages = [each for each in json.load(answer) if each["type"] == "page"]
            if pages:
                return pages[0]["webSocketDebuggerUrl"]
        time.sleep(0.2)
    raise TimeoutError(f"Chromium does not listen: {log.read_text(errors='replace')[-500:]}")
