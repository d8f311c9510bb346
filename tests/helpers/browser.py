"""A real browser for tests: headless Chromium through chromedriver's HTTP interface (W3C WebDriver), no package needed.

It opens a file from file:// or an address as a reader would, clicks and types, and keeps what the page wrote to the
console and every address that it asked for. `Browser.start` raises where Chromium or chromedriver is missing: its tests
then fail, they are not skipped.
"""

import base64
import contextlib
import json
import shutil
import socket
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

INSTALL = "install both (Debian: apt-get install chromium chromium-driver)"
ELEMENT = "element-6066-11e4-a52e-4f735466cecf"  # the key of an element's reference, fixed by W3C WebDriver
KEYS = {"right": "\ue014", "left": "\ue012", "home": "\ue011", "end": "\ue010"}
KEYS |= {"enter": "\ue007", "escape": "\ue00c", "tab": "\ue004"}
DOWNLOADS = "downloads"
PATIENCE = 120  # seconds; a busy machine starts Chromium slowly
OPTIONS = ("--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--force-device-scale-factor=1")


def executables() -> tuple[str, str]:
    """Paths of Chromium and chromedriver.

    Raises:
        RuntimeError: one of them is missing.
    """
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    driver = shutil.which("chromedriver")
    if chromium is None or driver is None:
        missing = " and ".join(n for n, p in (("chromium", chromium), ("chromedriver", driver)) if p is None)
        raise RuntimeError(f"no {missing} on this machine: {INSTALL}")
    return chromium, driver


@dataclass
class Browser:
    """One session; make it with `Browser.start`."""

    address: str  # of the session
    console: list[str] = field(default_factory=list)  # what was read of the console so far

    @classmethod
    @contextlib.contextmanager
    def start(cls, folder: Path, width: int = 1280, height: int = 900) -> Iterator["Browser"]:
        """Starts Chromium with an empty profile in `folder` and a window of that many CSS pixels; what it downloads
        lies in the folder `DOWNLOADS` there.

        Raises:
            RuntimeError: Chromium or chromedriver is missing, or does not start.
        """
        chromium, driver = executables()
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        process = subprocess.Popen([driver, f"--port={port}"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        base = f"http://127.0.0.1:{port}"
        try:
            _await(base)
            # A phone is narrower than a window may be: the screen is emulated.
            screen = {"deviceMetrics": {"width": width, "height": height, "pixelRatio": 1, "touch": False}}
            downloads = folder / DOWNLOADS
            downloads.mkdir(parents=True, exist_ok=True)
            options = {
                "binary": chromium,
                "args": [*OPTIONS, f"--user-data-dir={folder / 'profile'}"],
                "mobileEmulation": screen,
                "prefs": {"download.default_directory": str(downloads.resolve())},
            }
            wanted = {"goog:chromeOptions": options, "goog:loggingPrefs": {"browser": "ALL", "performance": "ALL"}}
            made = _call(f"{base}/session", {"capabilities": {"alwaysMatch": wanted}})
            browser = cls(f"{base}/session/{made['sessionId']}")
            try:
                yield browser
            finally:
                _call(browser.address, method="DELETE")
        finally:
            process.terminate()
            process.wait(PATIENCE)

    def open(self, page: Path | str) -> None:
        """Opens a file from file://, or an address, and waits until it is loaded."""
        _call(f"{self.address}/url", {"url": page.resolve().as_uri() if isinstance(page, Path) else page})

    def ask(self, script: str, *arguments: Any) -> Any:
        """Runs JavaScript in the page and returns its value; `arguments[i]` are the arguments."""
        return _call(f"{self.address}/execute/sync", {"script": script, "args": list(arguments)})

    def element(self, selector: str) -> str:
        """Address of the first element that a CSS selector finds."""
        found = _call(f"{self.address}/element", {"using": "css selector", "value": selector})
        return f"{self.address}/element/{found[ELEMENT]}"

    def click(self, selector: str) -> None:
        """A real click: fails where the element is not to be seen, or another lies over it."""
        into_view = "document.querySelector(arguments[0]).scrollIntoView({block: 'center', behavior: 'instant'})"
        self.ask(into_view, selector)
        _call(f"{self.element(selector)}/click", {})

    def press(self, selector: str, key: str) -> None:
        """Types one key (of `KEYS`, or a letter) into an element."""
        _call(f"{self.element(selector)}/value", {"text": KEYS.get(key, key)})

    def upload(self, selector: str, path: Path) -> None:
        """Chooses a file for an `<input type="file">`, as its dialogue would; it may be hidden, or still to come."""
        self.wait("return document.querySelector(arguments[0]) != null", selector)
        _call(f"{self.element(selector)}/value", {"text": str(path.resolve())})

    def wait(self, script: str, *arguments: Any, seconds: float = PATIENCE) -> Any:
        """The value of JavaScript, as soon as it is true.

        Raises:
            TimeoutError: it never was.
        """
        end = time.monotonic() + seconds
        while not (value := self.ask(script, *arguments)):
            if time.monotonic() > end:
                raise TimeoutError(f"after {seconds:g} s still not true in the page: {script} {arguments or ''}")
            time.sleep(0.02)
        return value

    def drag(self, selector: str, start: float, end: float) -> None:
        """Drags the mouse inside an element, from and to fractions of its width, at half of its height."""
        box = _call(f"{self.element(selector)}/rect")
        offsets = [round((x - 0.5) * box["width"]) for x in (start, end)]
        element = {ELEMENT: self.element(selector).rsplit("/", 1)[1]}
        moves = [{"type": "pointerMove", "duration": 50, "x": x, "y": 0, "origin": element} for x in offsets]
        steps = [moves[0], {"type": "pointerDown", "button": 0}, moves[1], {"type": "pointerUp", "button": 0}]
        _call(f"{self.address}/actions", {"actions": [{"type": "pointer", "id": "mouse", "actions": steps}]})

    def screenshot(self, path: Path) -> None:
        """The window as a PNG."""
        path.write_bytes(base64.b64decode(_call(f"{self.address}/screenshot")))

    def errors(self) -> list[str]:
        """Everything that the page wrote to the console or failed at, since the browser was started."""
        entries = _call(f"{self.address}/se/log", {"type": "browser"})
        self.console += [f"{entry['level']}: {entry['message']}" for entry in entries]
        return list(self.console)

    def requests(self) -> list[str]:
        """Addresses that pages asked for since this was last read; without data: and the browser's own start page."""
        entries = _call(f"{self.address}/se/log", {"type": "performance"})
        events = [json.loads(entry["message"])["message"] for entry in entries]
        asked = [e["params"]["request"]["url"] for e in events if e["method"] == "Network.requestWillBeSent"]
        return [address for address in asked if not address.startswith(("data:", "chrome:", "chrome-untrusted:"))]


def _call(address: str, body: Any = None, method: str | None = None) -> Any:
    """One request of the protocol; its `value`."""
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(address, data, {"Content-Type": "application/json"}, method=method)
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        with opener.open(request, timeout=PATIENCE) as answer:
            return json.load(answer)["value"]
    except urllib.error.HTTPError as error:
        raise RuntimeError(f"chromedriver: {json.load(error)['value']['message'].splitlines()[0]}") from error


def _await(base: str) -> None:
    end = time.monotonic() + PATIENCE
    while True:
        try:
            if _call(f"{base}/status")["ready"]:
                return
        except OSError:
            pass
        if time.monotonic() > end:
            raise RuntimeError(f"chromedriver does not answer at {base} within {PATIENCE} s")
        time.sleep(0.1)
