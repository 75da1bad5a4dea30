// What the water, the lamp and the camera do to colors: the numbers of a step, and what photo.wgsl and water.wgsl share.
const BETA_D = 0u;       // (3,) attenuation, 1 / scene unit
const BETA_B = 3u;       // (3,) increase of the backscatter, 1 / scene unit
const BACKGROUND = 6u;   // (9, 3) raw SH coefficients of the background light
const TAU = 33u;         // of the lamp, over the squared median range
const UNIT_RANGE = 34u;  // median range, scene units
const GAINS = 35u;       // (3,) of the exposure
const VIGNETTING = 38u;  // (3,) coefficients
const CENTRE = 41u;      // (2,) principal point, fractions of width and height
const BOUNDS = 43u;      // (2,) least and most of the vignetting's gain
const COLOR_BEHIND = 45u;  // (3,) display color behind the Gaussians where there is no open water
const BEAM = 48u;        // (14,) coefficients, and most of the polynomial's absolute value: 0 for no beam
const BEAM_TERMS = 14u;
const COEFFICIENTS = 33u;

// Bits of `mode`.
const WATER = 1u;        // there is water
const LINEAR = 2u;       // whose formula works on linear light
const LAMP = 4u;         // there is a lamp
const GAIN = 8u;         // there is exposure, vignetting or a beam
const OPEN = 16u;        // the background light is behind the Gaussians
const SIMILARITY = 32u;  // SSIM is part of the loss

@group(0) @binding(1) var<storage, read> numbers: array<f32>;

// The background light of one channel: the sigmoid of its SH.
fn background_light(basis: ptr<function, array<f32, 16>>, count: u32, channel: u32) -> f32 {
    var raw = 0.0;
    for (var k = 0u; k < count; k++) { raw += (*basis)[k] * numbers[BACKGROUND + 3u * k + channel]; }
    return 1.0 / (1.0 + exp(-raw));
}
