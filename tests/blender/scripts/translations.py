"""Words that the interface shows."""

import re

import bpy
from bl_ext.user_default.swag_splatting.swag_blender import (
    color_chart,
    effect_pictures,
    effects,
    job,
    run_list,
    run_quality,
    selection_tools,
    survey_map,
)
from bl_ext.user_default.swag_splatting.swag_blender.nodes import splat_preview
from bl_ext.user_default.swag_splatting.swag_engine.settings.effect_figures import FIGURES
from bl_ext.user_default.swag_splatting.swag_engine.settings.effect_names import EFFECTS

KINDS = (
    bpy.types.Operator,
    bpy.types.Panel,
    bpy.types.Menu,
    bpy.types.PropertyGroup,
    bpy.types.AddonPreferences,
    bpy.types.FileHandler,
)
OF_SCRIPTS = ("SwagStatus", "SwagJob", "SwagSurveyJob", "SwagSurveyJobs")
"""Groups of properties whose values alone panels show."""


def subclasses(kind):
    """All classes below a class."""
    for cls in kind.__subclasses__():
        yield cls
        yield from subclasses(cls)


def shown_words():
    """Names and descriptions of the extension's registered classes and their properties."""
    classes = {cls for kind in KINDS for cls in subclasses(kind)}
    found = set()
    for cls in classes:
        if "swag_splatting" not in cls.__module__ or not cls.is_registered or cls.__name__ in OF_SCRIPTS:
            continue
        rna = cls.bl_rna
        if issubclass(cls, bpy.types.Operator):
            rna = getattr(bpy.ops.swag, cls.bl_idname.partition(".")[2]).get_rna_type()
            found.add(rna.description)
        found.add(getattr(cls, "bl_label", ""))
        own = {
            name
            for base in cls.__mro__
            if "swag_splatting" in base.__module__
            for name in vars(base).get("__annotations__", ())
        }
        for prop in (rna.properties[name] for name in own & set(rna.properties.keys())):
            if not prop.is_hidden:
                for item in (prop, *getattr(prop, "enum_items", ())):
                    found |= {item.description} | ({item.name} - {item.identifier})
    found |= {words.statement for words in EFFECTS.values()} | {words.sentence for words in EFFECTS.values()}
    found |= {name.replace("_", " ").capitalize() for name in EFFECTS}
    found |= {figure.label for figures in FIGURES.values() for figure in figures.values()}
    found |= {sentence for _, sentence in effects.STATES.values()} | {effects.NO_WATER, effects.WATER_UNKNOWN}
    found |= {text for tool in selection_tools.TOOLS for text in (tool.bl_label, tool.bl_description)}
    found |= {text for one in run_quality.QUALITIES for text in (one.word, one.meaning)}
    found |= {
        splat_preview.FACE_CAMERA,
        *effect_pictures.COLUMNS,
        *run_list.LABELS.values(),
        *color_chart.ROWS,
        *(state.title for state in survey_map.STATES.values()),
        "Stopped",
        "Finished",
        job.NO_PHOTOS,
    }
    return sorted(word for word in found if re.search("[A-Za-z]{2}", word))
