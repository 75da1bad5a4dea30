"""Answers to the worker's requests for maps and measurements."""

from collections.abc import Callable
from typing import Any

from .protocol import AreasRequest, ChangeRequest, DemRequest, MapRequest, OrthoRequest, ProfileRequest


def make_map(request: MapRequest, progress: Callable[[str, float], None]) -> dict[str, Any]:
    """Write what a request for a map asks for.

    Args:
        request: The request.
        progress: Called with the stage and its fraction; what it raises ends the work.

    Returns:
        What the function of the command of that name returns, with `request`, its name.

    Raises:
        InputError: If an option or a file cannot be used.
    """
    run, out, pixel, plane = request.run, request.out, request.pixel, request.plane
    if isinstance(request, OrthoRequest):
        from ..products.ortho import make_ortho

        options = request.water, request.develop, request.taglab
        return {"request": "ortho"} | make_ortho(run, out, pixel, None, plane, *options, progress=progress)
    if isinstance(request, DemRequest):
        from ..products.dem import make_dem

        derived = tuple(name for name in request.derived.split(",") if name)
        return {"request": "dem"} | make_dem(run, out, pixel, None, plane, derived, progress=progress)
    if isinstance(request, AreasRequest):
        from ..products.areas import make_areas

        corrected = request.corrected
        return {"request": "areas"} | make_areas(run, out, pixel, None, plane, corrected=corrected, progress=progress)
    if isinstance(request, ProfileRequest):
        from ..products.profile import make_profile

        return {"request": "profile"} | make_profile(run, request.line, out, pixel, plane, progress=progress)
    assert isinstance(request, ChangeRequest)
    from ..products.change import ScaleChoice, make_change

    scale: ScaleChoice = "free" if request.free_scale else "fixed"
    return {"request": "change"} | make_change(run, request.later, out, pixel, None, plane, scale, progress=progress)
