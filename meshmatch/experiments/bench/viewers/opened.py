"""Run Khronos' validator, Blender and three.js as subprocesses, and collect what they find in files."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import tempfile
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from meshmatch import blender
from meshmatch.errors import InputError, OptionError

TOOLS = ("validator", "blender", "three")
HERE = Path(__file__).parent
_CHROMIUM = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_VARIABLE = "MESHMATCH_CHROMIUM"
_CHROMIUM_OPTIONS = (
    *("--headless=new", "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", "--disable-extensions"),
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader"),  # WebGL without a graphics card
)
_TIMEOUT = 900.0
_MODULES = {"validator": "gltf-validator", "three": "three"}
Found = dict[str, dict[str, Any]]
"""Record of each file by its path: what was found, or ``error``, why it could not be opened."""


def check_tools(tools: Sequence[str], modules: Path) -> None:
    """Raise `OptionError` for tools that are not installed."""
    for tool, package in _MODULES.items():
        if tool in tools and not (modules / package / "package.json").is_file():
            hint = (
                f"npm install --prefix FOLDER {package}, and name FOLDER/node_modules with --modules, or choose --tools"
            )
            raise OptionError(f"there is no {package} in {modules}", hint)
    if "validator" in tools and shutil.which("node") is None:
        raise OptionError("there is no node, which runs Khronos' validator", "install Node.js, or choose --tools")
    if "three" in tools:
        _chromium()
    if "blender" in tools:
        blender.command("result.blend")


def _chromium() -> str:
    """Return the path of Chromium; `OptionError` if there is none."""
    found = os.environ.get(_VARIABLE) or next(filter(None, map(shutil.which, _CHROMIUM)), None)
    if found is None:
        raise OptionError(
            "there is no Chromium, which runs three.js", f"install it, name it by {_VARIABLE}, or choose --tools"
        )
    return found


def validate_gltf(files: Sequence[Path], modules: Path) -> Found:
    """Validate glTF files by Khronos' validator; severity 0 of an issue is an error, 1 a warning."""
    if not files:
        return {}
    words = ["node", str(HERE / "validate.cjs"), str(modules.absolute()), *map(str, files)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=_TIMEOUT, check=False)
    if done.returncode:
        raise InputError(
            f"Khronos' validator ended with status {done.returncode}", (done.stderr.splitlines() or [""])[-1]
        )
    records = [json.loads(line) for line in done.stdout.splitlines()]
    return {str(Path(record.pop("file"))): record for record in records}


def issues(found: Found, file: Path, target: Path | None = None) -> Counter[tuple[int, str]]:
    """Count errors and warnings of a file, by severity and code, without those of the target that it was made from."""

    def of(path: Path) -> Counter[tuple[int, str]]:
        record = found[str(path)]
        return Counter([(0, str(record["error"]))] if "error" in record else
                       [(each["severity"], each["code"]) for each in record["issues"] if each["severity"] < 2])  # fmt: skip

    return of(file) - (Counter() if target is None else of(target))


def open_in_blender(files: Sequence[Path], pictures: Path) -> Found:
    """Open files in Blender, each in a new scene; it is restarted after a file that crashes it."""
    found: Found = {}
    while left := [file for file in files if str(file) not in found]:
        words = [
            *blender.command("result.blend"),
            str(HERE / "_blender" / "look.py"),
            "--",
            *map(str, [pictures, *left]),
        ]
        done = subprocess.run(words, capture_output=True, text=True, timeout=_TIMEOUT, check=False)
        records = [json.loads(line) for line in done.stdout.splitlines() if line.startswith('{"file"')]
        found |= {str(Path(record.pop("file"))): record for record in records}
        if len(records) < len(left):
            found[str(left[len(records)])] = {"error": f"Blender ended with status {done.returncode}"}
    return found


class _Page(SimpleHTTPRequestHandler):
    """HTTP handler that serves the page, three.js and a folder of files, and collects the records that the page posts."""

    def __init__(
        self, *words: Any, files: Sequence[Path], modules: Path, records: Found, done: threading.Event
    ) -> None:
        self.files, self.modules, self.records, self.done = files, modules, records, done
        super().__init__(*words)

    def translate_path(self, path: str) -> str:
        area, _, rest = unquote(path.partition("?")[0]).lstrip("/").partition("/")
        root = {"three": self.modules / "three", "made": self.files[0].parent}.get(area)
        if root is None:
            return str(HERE / "three.html")
        inside = (root / rest).resolve()
        return str(inside if inside.is_relative_to(root.resolve()) else HERE / "nothing")

    def do_GET(self) -> None:
        if self.path != "/files":
            super().do_GET()
            return
        self._answer(json.dumps([file.name for file in self.files]).encode())

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        if self.path == "/told":
            record = json.loads(body)
            self.records[record.pop("file")] = record
        self._answer(b"")
        if self.path == "/done":
            self.done.set()

    def _answer(self, data: bytes) -> None:
        self.send_response(200)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, format: str, *args: Any) -> None:
        """Do not log requests."""


@contextmanager
def _served(handler: Any) -> Iterator[str]:
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}/"
        finally:
            server.shutdown()
            thread.join()


def open_in_three(files: Sequence[Path], pictures: Path, modules: Path) -> Found:
    """Open files of one folder in three.js, in a headless browser."""
    records: Found = {}
    done = threading.Event()
    handler = partial(_Page, files=files, modules=modules.absolute(), records=records, done=done)
    with _served(handler) as address, tempfile.TemporaryDirectory(prefix="meshmatch-") as profile:
        words = [_chromium(), *_CHROMIUM_OPTIONS, f"--user-data-dir={profile}", address]
        browser = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            waited = 0.0
            while not done.wait(0.5) and browser.poll() is None and waited < _TIMEOUT:
                waited += 0.5
        finally:
            browser.terminate()
            browser.wait()
    for name, record in records.items():
        for key, ending in (("picture", ""), ("picture_moved", "-moved")):
            if (picture := record.pop(key, None)) is not None:
                data = base64.b64decode(picture.partition(",")[2])
                (pictures / f"{name}-three{ending}.png").write_bytes(data)
    lost = {"error": "the browser ended before"}
    return {str(file): records.get(file.name, lost) for file in files}
