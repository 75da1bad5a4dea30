"""Node and a browser for the programs of others that read our files."""

import os
import platform
import subprocess
import sys
import tempfile
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import pytest

from tests.interop.install import CHROMIUM, HERE, NODE, install

# WebGL on the processor: the machines that test have no graphics card.
CHROMIUM_FLAGS = ("--headless", "--no-sandbox", "--no-first-run", "--use-angle=swiftshader",
                  "--enable-unsafe-swiftshader")  # fmt: skip


@pytest.fixture(scope="session")
def npm_packages(missing):
    """The packages of package-lock.json are installed, once."""
    try:
        install()
    except (OSError, subprocess.SubprocessError) as error:
        commands = "`make .venv/ready` and `.venv/bin/python tests/interop/install.py`"
        missing(f"Node or the npm packages of tests/interop are missing ({error}): run {commands}.")


@pytest.fixture(scope="session")
def node(npm_packages):
    """Runs a script of tests/interop with node and returns what it printed."""

    def run(script, *arguments):
        done = subprocess.run([NODE, HERE / script, *arguments], capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    return run


@pytest.fixture(scope="session")
def browser(npm_packages, missing):
    """Opens a page of tests/interop on a GLB in headless Chromium; returns the PNG that the page draws."""
    if (sys.platform, platform.machine()) != ("linux", "x86_64"):
        missing("The Chromium of tests/interop runs on Linux on x86-64 processors only: use such a machine.")
    environment = os.environ | {"LD_LIBRARY_PATH": str(CHROMIUM / "al2023" / "lib")}

    def show(page, glb, width, height):
        answer = {}
        answered = threading.Event()

        class Server(SimpleHTTPRequestHandler):
            def __init__(self, *arguments):
                super().__init__(*arguments, directory=HERE)

            def translate_path(self, path):
                return str(glb) if path == "/scene.glb" else super().translate_path(path)

            def do_POST(self):  # noqa: N802
                answer[self.path] = self.rfile.read(int(self.headers["Content-Length"]))
                self.send_response(200)
                self.end_headers()
                answered.set()

            def log_message(self, *_):
                pass

        with ThreadingHTTPServer(("127.0.0.1", 0), Server) as server, tempfile.TemporaryDirectory() as profile:
            threading.Thread(target=server.serve_forever, daemon=True).start()
            address = f"http://127.0.0.1:{server.server_port}/{page}?width={width}&height={height}"
            command = [str(CHROMIUM / "chromium"), *CHROMIUM_FLAGS, f"--user-data-dir={profile}", address]
            nowhere = subprocess.DEVNULL
            process = subprocess.Popen(command, env=environment, stdout=nowhere, stderr=nowhere)
            try:
                answered.wait(120)
            finally:
                process.terminate()
                process.wait(20)
                server.shutdown()
        assert "/picture" in answer, answer.get("/problem", b"the page did not answer within 2 minutes").decode()
        return answer["/picture"]

    return show
