"""Blender as a process: a line of standard input names folders and files that `swag import` takes, as a JSON list;
a line of standard output says what they become as objects of one scene.

BLENDER_USER_RESOURCES names an empty folder of user files. The extension is this repository itself. One worker answers
all, and the scene's nodes are kept: both take long to make.
"""

import json
import os
import sys
from pathlib import Path

import bpy
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
SIZES = {"FLOAT": ("value", 1), "FLOAT_VECTOR": ("vector", 3), "FLOAT_COLOR": ("color", 4), "QUATERNION": ("value", 4)}


def is_finite(cloud: bpy.types.PointCloud) -> bool:
    """Return whether every attribute of every point is finite."""
    for attribute in cloud.attributes:
        if attribute.data_type in SIZES:
            name, size = SIZES[attribute.data_type]
            values = np.empty(size * len(cloud.points), np.float32)
            attribute.data.foreach_get(name, values)
            if not np.isfinite(values).all():
                return False
    return True


def held() -> dict[str, object]:
    """Return the points of each cloud, the number of cameras, and the objects with values that are not finite."""
    objects = list(bpy.context.scene.objects)
    bpy.context.view_layer.update()
    clouds = [obj for obj in objects if obj.type == "POINTCLOUD"]
    wrong = {obj.name for obj in objects if not np.isfinite(obj.matrix_world).all()}
    return {
        "clouds": {obj.name: len(obj.data.points) for obj in clouds},
        "cameras": sum(obj.type == "CAMERA" for obj in objects),
        "not finite": sorted(wrong | {obj.name for obj in clouds if not is_finite(obj.data)}),
    }


def main() -> None:
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # Blender's own output is not part of the answers
    extension = Path(bpy.utils.user_resource("EXTENSIONS")) / "user_default" / "swag_splatting"
    extension.parent.mkdir(parents=True)
    extension.symlink_to(ROOT)
    import addon_utils  # Blender's own

    assert addon_utils.enable("bl_ext.user_default.swag_splatting", default_set=True)
    from bl_ext.user_default.swag_splatting.swag_blender import commands, engine_process, job

    class Kept(engine_process.Engine):
        def stop(self) -> None:
            pass

    bpy.ops.wm.read_homefile(use_empty=True)
    engine = Kept()
    job.Engine = lambda: engine  # type: ignore[misc, assignment]
    for line in sys.stdin:
        try:
            for path in json.loads(line):
                commands.bring_in(Path(path))
            answer = held()
        except (commands.InputError, RuntimeError, OSError) as error:  # as the command answers them
            answer = {"error": str(error)}
        print(json.dumps(answer), file=answers, flush=True)
        data = bpy.data
        bpy.data.batch_remove({*data.objects, *data.pointclouds, *data.cameras, *data.images, *data.collections})


main()
