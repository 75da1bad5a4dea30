from pathlib import Path

import pytest

from swag_engine.sfm.child_process import run_child

ROOT = Path(__file__).resolve().parents[2]


def test_a_child_ignores_code_in_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, code in {
        "current/swag_engine/__init__.py": "raise ImportError",
        "modules/where.py": "import swag_engine\nfrom swag_engine.sfm.child_process import do_job\n\n"
        "do_job(lambda task: {'file': swag_engine.__file__})\n",
    }.items():
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).write_text(code)
    monkeypatch.chdir(tmp_path / "current")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "modules"))
    result = run_child("where", {}, tmp_path, "", lambda stage, fraction: None)
    assert Path(result["file"]).parents[1] == ROOT
