"""The node groups as an asset library."""


def test_node_groups_are_assets_of_a_library(blender):
    """The library is written, listed and usable in another file; it is delisted while the extension is disabled."""
    blender.run("assets.write_use_and_remove")
