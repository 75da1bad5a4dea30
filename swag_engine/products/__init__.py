"""What surveys publish of a scene: orthomosaics, heights, areas by label, profiles and change."""
