"""Node and a browser for the programs that judge our files."""

import shutil
import subprocess
import tempfile
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

HERE = Path(__file__).parent
# WebGL by the processor: the machines that test have no graphics card.
CHROMIUM_FLAGS = ("--headless=new", "--no-sandbox", "--no-first-run", "--use-angle=swiftshader",
                  "--enable-unsafe-swiftshader")  # fmt: skip


@pytest.fixture(scope="session")
def npm_packages():
    """The packages of package-lock.json are installed, once."""
    if not (shutil.which("node") and shutil.which("npm")):
        pytest.skip("node and npm are not installed")
    lock, installed = HERE / "package-lock.json", HERE / "node_modules" / ".package-lock.json"
    if installed.exists() and installed.stat().st_mtime >= lock.stat().st_mtime:
        return
    command = ["npm", "ci", "--ignore-scripts", "--omit=peer", "--no-audit", "--no-fund"]
    try:
        done = subprocess.run(command, cwd=HERE, capture_output=True, text=True, timeout=300)
    except subprocess.TimeoutExpired:
        pytest.skip("the npm packages of tests/interop did not arrive within 5 minutes")
    if done.returncode:
        reason = next((line for line in done.stderr.splitlines() if line.startswith("npm error")), "npm failed")
        pytest.skip(f"the npm packages of tests/interop cannot be had: {reason}")


@pytest.fixture(scope="session")
def node(npm_packages):
    """Runs a script of tests/interop with node and returns what it printed."""

    def run(script, *arguments):
        done = subprocess.run(["node", HERE / script, *arguments], capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    return run


@pytest.fixture(scope="session")
def browser(npm_packages):
    """Opens a page of tests/interop on a GLB in headless Chromium; returns the PNG that the page draws."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("Chromium is not installed")

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
            command = [chromium, *CHROMIUM_FLAGS, f"--user-data-dir={profile}", address]
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            try:
                answered.wait(120)
            finally:
                process.terminate()
                process.wait(20)
                server.shutdown()
        assert "/picture" in answer, answer.get("/problem", b"the page did not answer within 2 minutes").decode()
        return answer["/picture"]

    return show
