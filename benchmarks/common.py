"""Paths and helpers that the benchmark scripts share."""

import io
import json
import os
import platform
from pathlib import Path
from typing import Any

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
"""Figures, as JSON; docs/scripts/tables.py makes the tables of the documentation from them."""
PICTURES = ROOT / "docs" / "images"
"""Pictures of the documentation, as WebP."""
SHARED = ROOT.parent / "shared" / "data"
"""Scenes that are not part of the repository; a benchmark leaves out those that are missing."""
DEMO = ROOT / "tests" / "scenes" / "reef_wreck"
WEBP_QUALITY = 70
"""Quality of written pictures, 0 to 100: keeps each below 300 kB."""


def processor() -> str:
    """Name of the processor, where the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def machine() -> str:
    """Processor and number of its cores."""
    return f"{processor()}, {os.cpu_count()} cores"


def write_results(name: str, document: dict[str, Any]) -> None:
    """Write benchmarks/results/NAME.json: each entry of the document in one line, numbers with five digits."""
    rounded = json.loads(json.dumps(document), parse_float=lambda text: float(f"{float(text):.5g}"))
    entries = (f"{json.dumps(key)}:{json.dumps(value, separators=(',', ':'))}" for key, value in rounded.items())
    (RESULTS / f"{name}.json").write_text("{\n" + ",\n".join(entries) + "\n}\n", encoding="utf-8")


def save_figure(name: str, figure: Any, dpi: int) -> None:
    """Write a matplotlib figure to docs/images/NAME.webp."""
    figure.savefig(PICTURES / f"{name}.webp", dpi=dpi, pil_kwargs={"quality": WEBP_QUALITY})


def save_chart(name: str, figure: Any, dpi: int) -> None:
    """Write a matplotlib figure of few colors to docs/images/NAME.webp without loss."""
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=dpi)
    chart = Image.open(drawn).convert("RGB").quantize(32, dither=Image.Dither.NONE).convert("RGB")
    chart.save(PICTURES / f"{name}.webp", lossless=True, quality=100, method=6)
