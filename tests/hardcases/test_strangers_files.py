"""A folder or a file of a stranger can do no harm: nothing is deleted, written or run that is not the program's own."""

import csv
import json
import os
import shlex
import shutil
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio
from rasterio._err import CPLE_AppDefinedError

from swag_engine.app import cli
from swag_engine.app.batch import batch
from swag_engine.app.interrupts import Interrupts
from swag_engine.app.progress import stage_progress
from swag_engine.base import files
from swag_engine.base.errors import InputError
from swag_engine.base.files import atomic_path, inside, locked_folder, write_csv
from swag_engine.base.isolation import ROOT, child_environment
from swag_engine.base.tables import read_table
from swag_engine.base.text import command_text
from swag_engine.camera_files.registry import read_camera_file
from swag_engine.experiments import film
from swag_engine.experiments.evaluate_run import render_run
from swag_engine.experiments.film import FilmOptions, film_run
from swag_engine.formats.camera_path import PathFrame
from swag_engine.formats.export import export_run
from swag_engine.formats.gltf import read_glb
from swag_engine.formats.ply import read_ply, write_ply
from swag_engine.formats.run_folder import RunFolder
from swag_engine.formats.spz import read_spz
from swag_engine.formats.survey_folder import SurveyFolder
from swag_engine.products import geotiff
from swag_engine.products.ortho import make_ortho
from swag_engine.products.profile import make_profile
from swag_engine.scene import images
from swag_engine.scene.cameras import Camera
from swag_engine.scene.colmap import load_scene
from swag_engine.scene.images import decode_image, read_image
from swag_engine.scene.new_scene import new_scene
from swag_engine.scene.scene_part import part_of, read_part, write_part
from swag_engine.scene.split import Split
from swag_engine.survey import job
from swag_engine.survey.executors.child import Child
from swag_engine.survey.executors.protocol import Job
from swag_engine.survey.merge import merge_survey
from swag_engine.training.checkpoint import checkpoints
from tests.scenes.small_surveys import make_survey, random_splats


def documents(folder: Path) -> Path:
    """Make a folder with files of somebody else, among them names that this program uses."""
    for name in ("letter.txt", "done.json", "run/metrics.json", "0/a.ply", "new.ply", "scene/a.txt", "config.json"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text('{"version": 1}')
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.parametrize("part", ["merged", "merged/tiles", "merged/tiles/0", "blocks", "blocks/B-001", "coarse"])
def test_a_survey_with_a_link_is_refused(tmp_path, part):
    """Merging, and a block whose result is not what done.json says, delete files."""
    survey, others = make_survey(tmp_path / "survey", random_splats(200)), documents(tmp_path / "documents")
    before, place = contents(others), survey.path / part
    if place.exists():
        place.rename(tmp_path / "moved")
    place.parent.mkdir(parents=True, exist_ok=True)
    place.symlink_to(others)
    for work in (lambda: merge_survey(survey.path), lambda: job.run_job(survey.path, "B-001")):
        with pytest.raises(InputError, match=f"{part} is a link"):
            work()
    assert contents(others) == before


@pytest.mark.parametrize("name", ["../../documents", "{}/documents", "S-/../../documents", "B-001/..", "", "C:B-001"])
@pytest.mark.parametrize("field", ["blocks", "seams"])
def test_names_of_blocks_do_not_lead_out_of_a_survey(tmp_path, name, field):
    survey, others = make_survey(tmp_path / "survey", random_splats(200)), documents(tmp_path / "documents")
    name = name.format(tmp_path)
    document = json.loads(survey.survey.read_text())
    document[field] = [name]
    survey.survey.write_text(json.dumps(document))
    before = contents(tmp_path)
    for work in (lambda: merge_survey(survey.path), lambda: job.run_job(survey.path, name)):
        with pytest.raises(InputError, match="survey.json is damaged"):
            work()
    assert contents(tmp_path) == before and others.exists()
    block = survey.block_file("B-002")
    block.write_text(block.read_text().replace('"sides": []', f'"sides": [{json.dumps(name)}]'))
    with pytest.raises(InputError, match="block.json is damaged"):
        survey.read_block("B-002")


def test_merging_removes_its_own_tiles_alone(tmp_path):
    survey = make_survey(tmp_path, random_splats(200))
    merge_survey(survey.path)
    tiles = survey.merged / "tiles"
    own = [tiles / "0" / "0_-1_0-0123456789ab.ply", tiles / "new.ply", tiles / "7" / "0_0_0-0123456789ab.ply"]
    others = [tiles / "letter.txt", tiles / "0" / "reef.ply", survey.merged / "staging" / "letter.txt"]
    for path in own + others:
        path.parent.mkdir(exist_ok=True)
        path.write_text("x")
    merge_survey(survey.path)
    assert not any(path.exists() for path in own) and not (tiles / "7").exists()
    assert all(path.exists() for path in others)


@pytest.mark.parametrize("name", ["../outside.png", "/outside.png", "a/../../outside.png", "C:/outside.png"])
def test_names_of_views_do_not_lead_out_of_a_folder(tiny_scene, tmp_path, name):
    scene = load_scene(tiny_scene)
    first = scene.views[0]
    views = (replace(first, camera=replace(first.camera, name=name)), *scene.views[1:])
    write_part(tmp_path / "views.npz", part_of(replace(scene, views=views), Split((name,), (), ())))
    with pytest.raises(InputError, match="views.npz is damaged .*leads out"):
        read_part(tmp_path / "views.npz", tiny_scene)
    assert inside(name) in ("outside.png", "a/outside.png")


def test_a_folder_keeps_the_files_of_other_programs(tmp_path):
    """Those that look like temporary files, locks, and checkpoints."""
    names = (".a.part", ".tmpAb12Cd", ".lock", ".swag-0123", "checkpoint-best.safetensors")
    for name in names:
        (tmp_path / name).write_text("x")
    (tmp_path / ".swag-0123456789ab").mkdir()  # of a process of this program that was killed
    (tmp_path / ".swag-0123456789ab" / "result.ply").write_text("x")
    documents(tmp_path.parent / "documents")
    (tmp_path / ".swag-ffffffffffff").symlink_to(tmp_path.parent / "documents")
    with locked_folder(tmp_path):
        assert not (tmp_path / ".swag-0123456789ab").exists()
        assert checkpoints(tmp_path) == []
    assert set(names) <= set(os.listdir(tmp_path)) and (tmp_path.parent / "documents" / "letter.txt").exists()


def test_nothing_is_written_through_a_link(tmp_path):
    letter = documents(tmp_path / "documents") / "letter.txt"
    for name in ("metrics.jsonl", ".swag.lock", "water.json"):
        (tmp_path / name).symlink_to(letter)
    with pytest.raises(InputError, match="Cannot write .*metrics.jsonl"):
        RunFolder(tmp_path).log({"iteration": 1})
    with pytest.raises(InputError, match="Cannot write"), locked_folder(tmp_path):
        pass
    with atomic_path(tmp_path / "water.json") as temporary:
        temporary.write_text("{}")
    (tmp_path / ".new.swag-part").symlink_to(letter.parent)
    with pytest.raises(InputError, match="is a link"), new_scene(tmp_path / "new"):
        pass
    assert set(contents(letter.parent).values()) == {b'{"version": 1}'} and not (tmp_path / "water.json").is_symlink()


EVIL = 'import os, pathlib; pathlib.Path(os.environ["PROOF"]).write_text("ran"); raise SystemExit(7)\n'


@pytest.fixture
def evil_folder(tmp_path, monkeypatch):
    """The current folder is one whose files would run, or be obeyed, when they are imported."""
    folder = tmp_path / "current"
    for name in ("swag_engine/__init__.py", "swag_engine/__main__.py", "numpy.py", "tyro.py", "torch/__init__.py"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(EVIL)
    (folder / "matplotlibrc").write_text("savefig.dpi: 10\nlines.linewidth: 20\nbackend: module://numpy\n")
    monkeypatch.chdir(folder)
    monkeypatch.setenv("PROOF", str(tmp_path / "proof"))
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    return folder


def test_batch_and_survey_run_no_code_of_the_current_folder(evil_folder, tiny_scene, tmp_path):
    (tmp_path / "scenes" / "--resume").mkdir(parents=True)
    document = batch("inspect", tmp_path / "scenes", None, [], Interrupts())
    assert [row["state"] for row in document["rows"]] == ["not usable"]
    assert str(tmp_path / "scenes" / "--resume") in document["rows"][0]["error"]
    child = Child(Job(tmp_path / "none", "B-001", 1).words(), 1, str(ROOT))
    assert "is not a survey" in child.exit().error
    assert not (tmp_path / "proof").exists()


def test_the_command_runs_no_code_of_the_current_folder(evil_folder, tmp_path):
    shutil.rmtree(evil_folder / "swag_engine")  # with it, Python runs that one before any line of this program
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-m", "swag_engine", "targets", "--help"], env=environment, check=False)
    assert done.returncode == 0 and not (tmp_path / "proof").exists()


def test_a_matplotlibrc_in_the_current_folder_is_not_obeyed(evil_folder, tmp_path):
    code = "from swag_engine.experiments.page import new_plots; new_plots('x', 'y'); import matplotlib"
    code += "; print(matplotlib.rcParams['lines.linewidth'])"
    printed = subprocess.run([sys.executable, "-c", code], env=child_environment(), capture_output=True, check=True)
    assert printed.stdout == b"1.5\n"


@pytest.mark.parametrize("word", [r"C:\reef&calc.exe", "C:\\a b", "C:\\a;b", "C:\\(a)|b>c"])
def test_names_do_not_end_a_command_on_windows(word):
    assert command_text(["swag", word], windows=True) == f'swag "{word}"'
    for acting in ("%PATH%", "$(calc)", "`b", "a\u201d;calc", 'a";calc'):
        assert command_text(["swag", word + acting], windows=True) == "swag NAME"


def png(width: int, height: int) -> bytes:
    """Return a PNG of RGBA without pixels."""
    chunks = (b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0), b"IDAT")
    packed = (struct.pack(">I", len(c) - 4) + c + struct.pack(">I", zlib.crc32(c)) for c in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(packed)


@pytest.mark.parametrize("size", [(60_000, 60_000), (20_000, 20_000), (1_000_000, 270)])
def test_an_image_too_large_is_refused_by_its_header(tmp_path, size):
    (tmp_path / "a.png").write_bytes(png(*size))
    for read in (read_image, decode_image):
        with pytest.raises(InputError, match=f"a.png has {size[0] * size[1] / 1e6:.0f} million pixels"):
            read(tmp_path / "a.png")


def test_an_image_is_refused_where_its_memory_is_not_free(tmp_path, monkeypatch):
    (tmp_path / "a.png").write_bytes(png(1000, 1000))
    monkeypatch.setattr(images, "free_memory", lambda: 15_000_000)
    with pytest.raises(InputError, match="a.png has 1 million pixels, which need 0.0 GB"):
        read_image(tmp_path / "a.png")


def test_a_pipe_is_no_file(tiny_scene, tmp_path):
    """Reading one would wait for ever."""
    scene = shutil.copytree(tiny_scene, tmp_path / "scene")
    pipes: dict[Path, Callable[[], object]] = {
        scene / "images" / "view_00.png": lambda: read_image(scene / "images" / "view_00.png"),
        tmp_path / "config.json": RunFolder(tmp_path).read_config,
        tmp_path / "survey.json": SurveyFolder(tmp_path).read,
        tmp_path / "a.ply": lambda: read_ply(tmp_path / "a.ply"),
        tmp_path / "a.spz": lambda: read_spz(tmp_path / "a.spz"),
        tmp_path / "a.glb": lambda: read_glb(tmp_path / "a.glb"),
        scene / "sparse" / "0" / "points3D.txt": lambda: load_scene(scene),
        tmp_path / "views.npz": lambda: read_part(tmp_path / "views.npz", scene),
        tmp_path / "a.xml": lambda: read_camera_file(tmp_path / "a.xml"),
        tmp_path / "a.csv": lambda: read_table(tmp_path / "a.csv", ["name"]),
    }
    for path, read in pipes.items():
        path.unlink(missing_ok=True)
        os.mkfifo(path)
        with pytest.raises(InputError, match="no regular file|points3D.txt is missing") as caught:
            read()
        assert path.name in str(caught.value)
        path.unlink()
        if path.is_relative_to(scene):
            shutil.copy(tiny_scene / path.relative_to(scene), path)


def test_a_table_holds_no_formulas(tmp_path):
    cells = ['=HYPERLINK("http://a","b")', "+1+cmd", "@a", "\t=1", "-2+3", "-2.5", "1e-3", "-inf", "coral", None, -1.5]
    write_csv(tmp_path / "a.csv", ["=name"], [[cell] for cell in cells])
    with open(tmp_path / "a.csv", newline="") as file:
        read = [row[0] if row else "" for row in csv.reader(file)]
    assert read[1:6] == [f"'{cell}" for cell in cells[:5]] and read[0] == "'=name"
    assert read[6:8] == ["-2.5", "1e-3"] and read[9:] == ["coral", "", "-1.5"]


def test_names_do_nothing_to_a_terminal(capsys):
    name = "a\x1b]0;owned\x07\x9b2J\u202eb\udc80[red]"
    assert cli.main(["report", name]) == 2 and cli.main(["report", name, "--json"]) == 2
    with stage_progress() as progress:
        progress(name, 0.5)
    printed = "".join(capsys.readouterr())
    assert r"a\x1b]0;owned\x07\x9b2J\u202eb\udc80[red]" in printed
    assert not set(printed) & set("\x1b\x07\x9b\u202e\udc80")


@pytest.mark.parametrize("disk_is_full", [True, False])
def test_a_full_disk_in_maps_and_films_is_a_sentence(tmp_path, monkeypatch, disk_is_full):
    """The libraries that write them say less; films say nothing."""
    free = 0 if disk_is_full else 10**9
    monkeypatch.setattr(files.shutil, "disk_usage", lambda path: SimpleNamespace(free=free))
    remedy = "No space left on device; free some space" if disk_is_full else "choose another folder"
    camera = Camera("a", 32, 32, 9.0, 9.0, 16.0, 16.0, np.eye(4))
    with pytest.raises(InputError, match=f"a.mp4: .*{remedy}"), film._video_file(tmp_path / "a.mp4", camera, 24):
        pass  # without a frame there is no video
    write_ply(tmp_path / "a.ply", random_splats(200))
    monkeypatch.setattr(geotiff, "require_packages", lambda: rasterio)
    monkeypatch.setattr(rasterio, "open", lambda *_, **__: (_ for _ in ()).throw(CPLE_AppDefinedError(1, 1, "tag")))
    with pytest.raises(InputError, match=f"a.tif: .*{remedy}"):
        make_ortho(tmp_path / "a.ply", tmp_path / "a.tif", 0.5, None, "0,-1,0")
    assert sorted(os.listdir(tmp_path)) == ["a.ply"]


@pytest.mark.parametrize(
    "command, code",
    [("doctor > /dev/full", 2), ("doctor --json > /dev/full", 2), ("doctor | true; exit ${PIPESTATUS[0]}", 141),
     ("doctor 0<&- 2>&- > answer", 0), ("inspect $'a\\xff'", 2), ("doctor >&-", 0)],
)  # fmt: skip
def test_streams_that_are_closed_or_full(tmp_path, command, code):
    words = ["bash", "-c", f"{shlex.quote(sys.executable)} -m swag_engine {command}"]
    done = subprocess.run(words, cwd=tmp_path, env=child_environment(), capture_output=True, text=True, check=False)
    assert done.returncode == code and len(done.stderr.splitlines()) == (code == 2), done.stderr
    assert "answer" not in os.listdir(tmp_path) or "SWAG Splatting" in (tmp_path / "answer").read_text()


def test_no_output_replaces_a_photo_a_model_or_a_file_of_the_run(finished_run, tiny_scene, tmp_path):
    scene, run = shutil.copytree(tiny_scene, tmp_path / "scene"), shutil.copytree(finished_run, tmp_path / "run")
    config = json.loads((run / "config.json").read_text())
    (run / "config.json").write_text(json.dumps(config | {"scene": str(scene)}))
    (tmp_path / "link").symlink_to(scene / "images")
    before = {path: path.read_bytes() for folder in (scene, run) for path in folder.rglob("*") if path.is_file()}
    frame = PathFrame(load_scene(scene).views[0].camera)
    frame = PathFrame(replace(frame.camera, name="view_00"))
    refused = [
        lambda: render_run(run, scene / "images", None),
        lambda: render_run(run, tmp_path / "link", None),
        lambda: film_run(run, scene / "images", [frame], FilmOptions(overwrite=True)),
        lambda: export_run(run, "ply", scene / "images" / "view_03.png"),
        lambda: export_run(run, "ply", scene / "sparse" / "0" / "points3D.txt"),
        lambda: export_run(run, "ply", run / "result.ply"),
        lambda: export_run(run, "glb", run / "config.json"),
        lambda: export_run(run, "ply", next(run.glob("checkpoint-*"))),
        lambda: make_profile(run, (0.0, 0.0, 1.0, 1.0), scene / "images" / "view_00.csv"),
    ]
    for call in refused:
        with pytest.raises(InputError, match="is not replaced"):
            call()
    assert {path: path.read_bytes() for path in before} == before
    os.mkfifo(tmp_path / "pipe.ply")
    with pytest.raises(InputError, match="no regular file"):
        export_run(run, "ply", tmp_path / "pipe.ply")
    assert render_run(run, scene / "renders", None) and render_run(run, scene / "renders", None)
