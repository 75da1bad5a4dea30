"""Node trees and materials: the preview of splats, the fitted water, points."""
