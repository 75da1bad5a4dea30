"""The documentation shows the figures of benchmarks/results and the imports of the code, and its links work."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
LINK = re.compile(r"\]\(([^)#]+)[^)]*\)")
"""Target of a link or picture of Markdown, without its anchor."""


def test_a_checkout_is_below_thirty_megabytes(missing):
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=False)
    if listed.returncode:
        missing("These files are no checkout of git: clone the repository.")
    assert sum((ROOT / name).stat().st_size for name in listed.stdout.decode().split("\0")[:-1]) < 30e6


@pytest.fixture
def copy(tmp_path):
    """A copy of what the scripts of the documentation read."""
    root = tmp_path / "project"
    shutil.copytree(ROOT / "docs", root / "docs", ignore=shutil.ignore_patterns("*.webp", "__pycache__"))
    shutil.copytree(ROOT / "benchmarks" / "results", root / "benchmarks" / "results")
    for name in ("README.md", "__init__.py", ".importlinter"):
        shutil.copy(ROOT / name, root)
    for name in ("swag_engine", "swag_blender", "operators"):
        ignored = shutil.ignore_patterns("lib", "__pycache__", "*.c*", "*.h")
        shutil.copytree(ROOT / name, root / name, ignore=ignored)
    return root


def check(root: Path, script: str) -> subprocess.CompletedProcess:
    command = [sys.executable, str(root / "docs" / "scripts" / script), "--check"]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("page", ["README.md", "docs/effects.md"])
def test_a_changed_figure_is_found(copy, page):
    assert check(copy, "tables.py").returncode == 0
    path = copy / page
    rows = path.read_text("utf-8").split("<!-- table:", 1)
    changed = re.sub(r"\d", lambda digit: str((int(digit[0]) + 1) % 10), rows[1], count=1)
    path.write_text("<!-- table:".join([rows[0], changed]), "utf-8")
    done = check(copy, "tables.py")
    assert done.returncode == 1 and page in done.stdout


def test_a_changed_result_is_found(copy):
    path = copy / "benchmarks" / "results" / "raster.json"
    results = json.loads(path.read_text("utf-8"))
    times = results["rasterise 50 000 at 640x360, ms"]
    results["rasterise 50 000 at 640x360, ms"] = {name: time + 10 for name, time in times.items()}
    path.write_text(json.dumps(results), "utf-8")
    done = check(copy, "tables.py")
    assert done.returncode == 1 and "docs/accuracy.md" in done.stdout


def test_a_new_import_is_found(copy):
    assert check(copy, "import_diagram.py").returncode == 0
    with open(copy / "swag_engine" / "evaluation" / "metrics.py", "a", encoding="utf-8") as file:
        file.write("\nfrom ..settings import settings\n")
    done = check(copy, "import_diagram.py")
    assert done.returncode == 1 and "docs/architecture.md" in done.stdout


def test_links_of_the_readme_lead_somewhere():
    targets = [target for target in LINK.findall((ROOT / "README.md").read_text("utf-8")) if "://" not in target]
    assert len(targets) > 10
    assert [target for target in targets if not (ROOT / target).exists()] == []
