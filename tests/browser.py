"""A headless Chromium, if installed, driven over the WebDriver protocol."""

import json
import re
import shutil
import subprocess
import time
import urllib.request
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

__all__ = ["Browser"]

_WAIT_S = 60

_KEYS = {
    "Backspace": "\ue003",
    "Enter": "\ue007",
    "Control": "\ue009",
    "Escape": "\ue00c",
    "Left": "\ue012",
    "Up": "\ue013",
    "Right": "\ue014",
    "Down": "\ue015",
    "Delete": "\ue017",
}


def _strokes(keys: list[str]) -> list[dict[str, str]]:
    values = [_KEYS.get(key, key) for key in keys]
    down = [{"type": "keyDown", "value": value} for value in values]
    return down + [{"type": "keyUp", "value": value} for value in reversed(values)]


class Browser:
    """A headless Chromium, driven over the WebDriver protocol; without one, the test is skipped.

    ``folder`` is for the browser's profile and its downloads.
    """

    def __init__(self, folder: Path) -> None:
        driver = shutil.which("chromedriver")
        if driver is None or not (shutil.which("chromium") or shutil.which("google-chrome")):
            pytest.skip("no Chromium with its driver on this machine")
        self.downloads = folder / "downloads"
        self.downloads.mkdir()
        self._process = subprocess.Popen(
            [driver, "--port=0"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        assert self._process.stdout is not None
        ports = (re.search(r"successfully on port (\d+)", line) for line in self._process.stdout)
        self._base = f"http://127.0.0.1:{next(filter(None, ports))[1]}"
        arguments = [
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-extensions",
            "--disable-features=Translate,OptimizationHints,MediaRouter",
            "--window-size=1400,1000",
            f"--user-data-dir={folder / 'profile'}",
        ]
        options = {"args": arguments, "binary": shutil.which("chromium") or "google-chrome"}
        wanted = {
            "goog:chromeOptions": options,
            "goog:loggingPrefs": {"browser": "ALL"},
            "timeouts": {"pageLoad": 60000},
        }
        found = self._send("POST", "/session", {"capabilities": {"alwaysMatch": wanted}})
        self.session = found["sessionId"]
        where = {"behavior": "allow", "downloadPath": str(self.downloads)}
        self.cdp("Browser.setDownloadBehavior", where)

    def close(self) -> None:
        """End the browser and its driver."""
        try:
            self._send("DELETE", f"/session/{self.session}")
        finally:
            self._process.terminate()
            self._process.communicate(timeout=60)

    def _send(self, method: str, path: str, body: object = None) -> Any:
        content = None if body is None else json.dumps(body).encode()
        headers = {"Content-Type": "application/json"}
        request = urllib.request.Request(self._base + path, content, headers, method=method)  # noqa: S310  our own driver
        with urllib.request.urlopen(request, timeout=90) as answer:  # noqa: S310  the same
            return json.load(answer)["value"]

    def _ask(self, method: str, path: str, body: object = None) -> Any:
        return self._send(method, f"/session/{self.session}{path}", body)

    def open(self, page: Path | str) -> None:
        """Load a page from its file, or its address."""
        self._ask("POST", "/url", {"url": page.as_uri() if isinstance(page, Path) else page})

    def run(self, script: str) -> Any:
        """Run a script and return its result."""
        return self._ask("POST", "/execute/sync", {"script": script, "args": []})

    def _find(self, selector: str) -> str:
        found = self._ask("POST", "/element", {"using": "css selector", "value": selector})
        return str(next(iter(found.values())))

    def click(self, selector: str) -> None:
        """Click an element as a person does."""
        self._ask("POST", f"/element/{self._find(selector)}/click", {})

    def type(self, selector: str, text: str) -> None:
        """Type into an element."""
        self._ask("POST", f"/element/{self._find(selector)}/value", {"text": text})

    def press(self, *keys: str) -> None:
        """Press keys in turn on the focused element; ``Control+z`` is z with Control held down."""
        events = [event for key in keys for event in _strokes(key.split("+"))]
        source = {"type": "key", "id": "keyboard", "actions": events}
        self._ask("POST", "/actions", {"actions": [source]})

    def tab(self) -> str:
        """Open another tab, and return its handle; `switch_to` chooses the tab to drive."""
        return str(self._ask("POST", "/window/new", {"type": "tab"})["handle"])

    def tabs(self) -> list[str]:
        """Return the handles of the open tabs."""
        return [str(handle) for handle in self._ask("GET", "/window/handles")]

    def switch_to(self, tab: str) -> None:
        """Drive another tab from now on."""
        self._ask("POST", "/window", {"handle": tab})

    def close_tab(self) -> None:
        """Close the current tab."""
        self._ask("DELETE", "/window")

    def reset(self) -> None:
        """Close all tabs but one, and discard its page, stored corrections and console messages."""
        first, *others = self.tabs()
        for tab in others:
            self.switch_to(tab)
            self.close_tab()
        self.switch_to(first)
        self.open("about:blank")
        stored = {"origin": "file://", "storageTypes": "local_storage"}
        self.cdp("Storage.clearDataForOrigin", stored)
        self.console_messages()

    def wait(self, script: str) -> None:
        """Wait until a script returns true; fail after `_WAIT_S`."""
        deadline = time.monotonic() + _WAIT_S
        while time.monotonic() < deadline:
            if self.run(script) is True:
                return
            time.sleep(0.05)
        pytest.fail(f"never became true: {script}")

    def cdp(self, command: str, parameters: object) -> Any:
        """Send a command of the DevTools protocol."""
        return self._ask("POST", "/goog/cdp/execute", {"cmd": command, "params": parameters})

    def console_messages(self) -> list[str]:
        """Return the messages that the console has received since the last call."""
        return [entry["message"] for entry in self._ask("POST", "/se/log", {"type": "browser"})]

    def downloaded(self) -> Path:
        """Wait until a CSV file is downloaded; return its path."""
        deadline = time.monotonic() + _WAIT_S
        while time.monotonic() < deadline:
            with suppress(FileNotFoundError):  # the browser renames it
                found = [file for file in self.downloads.iterdir() if file.stat().st_size]
                if [file.suffix for file in found] == [".csv"]:  # no .crdownload or placeholder
                    return found[0]
            time.sleep(0.05)
        pytest.fail("nothing was downloaded")
