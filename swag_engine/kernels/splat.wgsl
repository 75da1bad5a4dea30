// A projected Gaussian as it is blended, as in splat.cuh: s = c u^2 + h dx^2 with u = dy + k dx.
const TILE = 16u;  // width and height, pixels
const LOG2E = 1.44269504;

struct Splat {
    x: f32, y: f32, k: f32, opacity: f32,
    c: f32, h: f32, limit: f32,         // limit: largest s that is not skipped
    half_width: f32, half_height: f32,  // of the ellipse s = limit
    top: f32,                           // x offset of the point at +half_height
}
