"""Shaders that draw splats as the engine's rasteriser does: EWA splatting as in Kerbl et al. 2023.

Splats are blended in display values (sRGB), as in training, in a buffer of their own. A last shader develops the
blended values, as swag_engine/splats/development.py does, and converts them to what Blender's overlay buffer holds.
Where splats are transparent the result is that of display values over the viewport's background, and close to it over
other objects.
"""

from typing import Any

import gpu
import numpy as np

from ...swag_engine.splats.development import GREY, NO_DEVELOPMENT, Development
from ...swag_engine.splats.splats import LEAST_VARIANCE
from ..nodes.formulas import SH_0, SH_FACTORS
from ..nodes.splat_shapes import FRUSTUM_MARGIN, MIN_ALPHA, PIXEL_VARIANCE
from .packing import GEOMETRY_TEXELS, HIDDEN_ALPHA

MAX_ALPHA = 0.99
"""Alphas are clamped to it, as in the engine."""
NEAR = 0.01
"""Depth below which centres are not drawn, as in the engine, scene units."""
LEAST_BLUR = 0.1
"""Variance in pixels squared that is always added, about that of a pixel: that of the 2D filter of Mip-Splatting (Yu et
al. 2024)."""
OVERLAY_GAMMA = 2.2
"""Exponent with which Blender lays its overlays over the scene, on any display (measured in 5.2: sRGB's own curve is
up to 7 levels of 255 off)."""
FLOOR_TOLERANCE = 0.01
"""Distance from the floor, as a fraction of 1 - depth, up to which a pixel may be of its grid in perspective:
0.0065 was measured. In orthographic views, depth is as exact everywhere."""
GRID_REACH = 2
"""Pixels from a line of the grid at which its depth is no longer found."""
FLOOR_CONSTANTS = ("floor_depth", "to_floor_x", "to_floor_y", "to_floor_w", "objects_on_floor")
"""Constants of the depth shader, for which `floor_constants` gives values."""
NO_FLOOR: dict[str, tuple[float, ...]] = dict.fromkeys(FLOOR_CONSTANTS, (0.0,) * 4)
"""Values of them where Blender draws no grid."""
DEVELOPMENT_ROWS = ("to_red", "to_green", "to_blue")
"""Constants of the composite shader: rows of the development's gains, with contrast, knee and a switch as fourth."""
VIEW_FLOATS = 52
"""Floats of the uniform buffer: 208 bytes, of which every device takes at least 16 KB."""

_VIEW = """
struct View {
  mat4 projection;
  vec4 focal_size;      /* focal lengths and size, in pixels */
  vec4 limits;          /* where x/z and y/z stop in the linearised projection: left, right, bottom, top */
  ivec4 layout_;        /* texture width, harmonics texels a splat, clip planes in use, orthographic */
  vec4 clip[6];         /* clip planes, in view space */
};
"""
_TRANSFER = """
vec3 to_light(vec3 v) {
  vec3 curved = pow(max((v + 0.055) / 1.055, vec3(0.0)), vec3(2.4));
  return mix(v / 12.92, curved, vec3(greaterThan(v, vec3(0.04045))));
}
vec3 to_display(vec3 v) {
  vec3 curved = 1.055 * pow(max(v, vec3(0.0)), vec3(1.0 / 2.4)) - 0.055;
  return mix(v * 12.92, curved, vec3(greaterThan(v, vec3(0.0031308))));
}
"""
_WATER = (
    _TRANSFER
    + """
void harmonics(vec3 d, out float y[16]) {
  float xx = d.x * d.x, yy = d.y * d.y, zz = d.z * d.z, around = 4.0 * zz - xx - yy;
  y[0] = SH_0;
  y[1] = -SH_F0 * d.y; y[2] = SH_F0 * d.z; y[3] = -SH_F0 * d.x;
  y[4] = SH_F1 * d.x * d.y; y[5] = -SH_F1 * d.y * d.z; y[6] = SH_F2 * (2.0 * zz - xx - yy);
  y[7] = -SH_F1 * d.x * d.z; y[8] = SH_F3 * (xx - yy);
  y[9] = -SH_F4 * d.y * (3.0 * xx - yy); y[10] = SH_F5 * d.x * d.y * d.z; y[11] = -SH_F6 * d.y * around;
  y[12] = SH_F7 * d.z * (2.0 * zz - 3.0 * xx - 3.0 * yy); y[13] = -SH_F6 * d.x * around;
  y[14] = SH_F8 * d.z * (xx - yy); y[15] = -SH_F4 * d.x * (xx - 3.0 * yy);
}
vec4 object_texel(int object, int row) { return texelFetch(objects, ivec2(row, object), 0); }
vec3 background_light(int object, vec3 direction) {
  float y[16];
  harmonics(direction, y);
  vec3 total = vec3(0.0);
  for (int k = 0; k < 9; k++) { total += object_texel(object, 8 + k).rgb * y[k]; }
  return object_texel(object, 6).a / (1.0 + exp(-total));
}
"""
)
_SPLAT_VERTEX = """
ivec2 texel(int number) { return ivec2(number % view.layout_.x, number / view.layout_.x); }

vec3 color(int splat, int object, vec3 direction, int degree) {
  int first = splat * view.layout_.y;
  vec3 total = texelFetch(harmonic_data, texel(first), 0).rgb * SH_0;
  if (degree > 0) {
    float y[16];
    harmonics(direction, y);
    total = vec3(0.0);
    int last = (degree + 1) * (degree + 1);
    for (int k = 0; k < last; k += 4) {
      int at = first + k / 4 * 3;
      vec4 a = texelFetch(harmonic_data, texel(at), 0);
      total += a.rgb * y[k];
      if (k + 1 < last) {
        vec4 b = texelFetch(harmonic_data, texel(at + 1), 0), c = texelFetch(harmonic_data, texel(at + 2), 0);
        total += vec3(a.a, b.rg) * y[k + 1] + vec3(b.ba, c.r) * y[k + 2] + c.gba * y[k + 3];
      }
    }
  }
  return max(total + 0.5, vec3(0.0));
}

vec3 through_water(int object, vec3 display, vec3 direction, float range) {
  vec4 attenuation = object_texel(object, 6), backscatter = object_texel(object, 7);
  bool of_display = backscatter.a > 0.5;
  vec3 own = of_display ? display : to_light(display);
  float path = range * attenuation.a;
  own = own * exp(-attenuation.rgb * path) +
        background_light(object, direction) * (1.0 - exp(-backscatter.rgb * path));
  return of_display ? own : to_display(own);
}

float random(int number) {
  uint h = uint(number) * 747796405u + 2891336453u;
  h = ((h >> ((h >> 28u) + 4u)) ^ h) * 277803737u;
  return float((h >> 22u) ^ h) / 4294967296.0;
}

void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);  /* outside: not drawn */
  vec2 numbers = texelFetch(order, texel(gl_InstanceID), 0).rg;
  int number = int(numbers.x + 0.5), object = int(numbers.y + 0.5);
  vec4 state = texelFetch(states, texel(number), 0);
  if (state.a > HIDDEN - 0.002) { return; }
  ivec2 first = texel(number * GEOMETRY);
  vec4 centre = texelFetch(geometry, first, 0);
  vec4 upper = texelFetch(geometry, texel(number * GEOMETRY + 1), 0);
  vec4 lower = texelFetch(geometry, texel(number * GEOMETRY + 2), 0);
  /* As much haze as is shown: `haze_gain` in swag_engine/splats/haze.py. */
  centre.w = min(centre.w * (1.0 + object_texel(object, 5).w * lower.w / (1.0 - lower.w)), 1.0);
  vec4 display = object_texel(object, 4);
  if (random(number) >= display.y || centre.w * 255.0 <= 1.0) { return; }
  if (display.z > 0.5) {
    vec4 p = vec4(centre.xyz, 1.0);
    vec3 inside = vec3(dot(object_texel(object, 17), p), dot(object_texel(object, 18), p),
                       dot(object_texel(object, 19), p));
    if (any(greaterThan(abs(inside), vec3(1.0)))) { return; }
  }
  vec4 x_row = object_texel(object, 0), y_row = object_texel(object, 1), z_row = object_texel(object, 2);
  vec4 p = vec4(centre.xyz, 1.0);
  vec3 v = vec3(dot(x_row, p), dot(y_row, p), dot(z_row, p));
  bool orthographic = view.layout_.w != 0;
  if (!orthographic && -v.z <= NEAR) { return; }
  for (int plane = 0; plane < view.layout_.z; plane++) {
    if (dot(view.clip[plane], vec4(v, 1.0)) < 0.0) { return; }
  }

  /* Rows of J R: how the image moves, in pixels, with the centre in the object's own space. */
  float inverse_z = orthographic ? 1.0 : 1.0 / -v.z;
  vec2 slope = orthographic ? vec2(0.0) : clamp(v.xy * inverse_z, view.limits.xz, view.limits.yw);
  vec3 along_x = view.focal_size.x * inverse_z * (x_row.xyz + slope.x * z_row.xyz);
  vec3 along_y = view.focal_size.y * inverse_z * (y_row.xyz + slope.y * z_row.xyz);
  mat3 covariance = mat3(upper.x, upper.y, upper.z, upper.y, upper.w, lower.x, upper.z, lower.x, lower.y);
  vec3 c_x = covariance * along_x, c_y = covariance * along_y;
  /* In a view of more pixels than the training images splats would be thinner than trained, with gaps between them; in
     one of fewer pixels they would be wider. They get the blur that these images have at the same distance. In a view
     of more pixels it is no more than that of the finest of these images, which limited the least variance. */
  float blur = BLUR;
  if (display.w > 0.0 && !orthographic) {
    /* Pixels of the training images, in pixels of the view. */
    float finest = view.focal_size.y * inverse_z * length(x_row.xyz) * sqrt(lower.z / LEAST_VARIANCE);
    float pixel = min(view.focal_size.y * display.w, max(finest, 1.0));
    blur = max(BLUR * pixel * pixel, LEAST_BLUR);
  }
  float xx = dot(along_x, c_x) + blur, xy = dot(along_x, c_y), yy = dot(along_y, c_y) + blur;
  float middle = 0.5 * (xx + yy), difference = 0.5 * (xx - yy);
  float apart = sqrt(max(difference * difference + xy * xy, 1e-20));
  float longest = middle + apart, widest = max(middle - apart, blur);
  vec2 axis = abs(xy) > 1e-9 * middle ? normalize(vec2(xy, longest - xx))
                                      : (xx >= yy ? vec2(1.0, 0.0) : vec2(0.0, 1.0));
  float reach = sqrt(2.0 * log(centre.w * 255.0));
  vec2 offset = corner.x * axis * sqrt(longest) * reach + corner.y * vec2(-axis.y, axis.x) * sqrt(widest) * reach;
  vec4 projected = view.projection * vec4(v, 1.0);
  projected.xy += offset * 2.0 / view.focal_size.zw * projected.w;

  vec4 eye = object_texel(object, 3);
  vec3 ray = centre.xyz - eye.xyz;
  vec3 direction = orthographic ? -object_texel(object, 5).xyz : normalize(ray);
  vec3 rgb = color(number, object, direction, min(int(display.x), view.layout_.y == 1 ? 0 : 3));
  if (object_texel(object, 6).a > 0.0) {
    rgb = through_water(object, rgb, direction, orthographic ? max(0.0, -v.z) : length(ray));
  }
  rgb = mix(rgb, to_display(state.rgb), state.a);
  tint = vec4(rgb, centre.w);
  place = corner * reach;
  gl_Position = projected;
}
"""
_SPLAT_FRAGMENT = """
void main() {
  float alpha = tint.a * exp(-0.5 * dot(place, place));
  if (alpha < LEAST) { discard; }
  alpha = min(alpha, MOST);
  blended = vec4(tint.rgb * alpha, alpha);
}
"""
_SCREEN_VERTEX = """
void main() {
  place = corner * 0.5 + 0.5;
  gl_Position = vec4(corner, DEPTH, 1.0);
}
"""
_DEPTH_FRAGMENT = """
/* Blender writes the lines of its floor grid into the depth, too, where they would cut through splats behind the floor.
   Where objects may lie in the floor, only what is thin is a line of the grid. */
vec3 on_screen(ivec2 pixel) {
  return vec3((vec2(pixel) + 0.5) / vec2(textureSize(depths, 0)) * 2.0 - 1.0, 1.0);
}
bool may_be_object(ivec2 pixel) {
  vec3 at = on_screen(pixel);
  vec2 xy = vec2(dot(to_floor_x.xyz, at), dot(to_floor_y.xyz, at)) / dot(to_floor_w.xyz, at);
  return all(greaterThanEqual(xy, objects_on_floor.xy)) && all(lessThanEqual(xy, objects_on_floor.zw));
}
bool on_floor(ivec2 pixel) {
  ivec2 size = textureSize(depths, 0);
  pixel = clamp(pixel, ivec2(0), size - 1);
  float depth = texelFetch(depths, pixel, 0).r;
  /* A line has the depth of its middle. */
  float tolerance = floor_depth.w * (1.0 - depth) + dot(abs(floor_depth.xy), 2.0 * GRID_REACH / vec2(size));
  return abs(depth - dot(floor_depth.xyz, on_screen(pixel))) < tolerance;
}
void main() {
  ivec2 pixel = ivec2(gl_FragCoord.xy);
  float depth = texelFetch(depths, pixel, 0).r;
  if (floor_depth.w > 0.0 && on_floor(pixel)) {
    if (!may_be_object(pixel)) { depth = 1.0; }
    for (int x = -1; x <= 1; x++) {
      for (int y = -1; y <= 1; y++) {
        if (!on_floor(pixel + GRID_REACH * ivec2(x, y))) { depth = 1.0; }
      }
    }
  }
  gl_FragDepth = depth;
}
"""
_BACKGROUND_FRAGMENT = """
void main() {
  if (color.a > 0.5) {
    blended = color;
    return;
  }
  /* The view's ray of this pixel, in the space of the object whose water it is. */
  vec2 at = place * 2.0 - 1.0;
  vec3 ray = view.layout_.w != 0 ? vec3(0.0, 0.0, -1.0)
      : vec3((at + vec2(view.projection[2][0], view.projection[2][1])) /
             vec2(view.projection[0][0], view.projection[1][1]), -1.0);
  int object = water_object;
  vec3 direction = normalize(object_texel(object, 20).xyz * ray.x + object_texel(object, 21).xyz * ray.y +
                             object_texel(object, 22).xyz * ray.z);
  vec3 light = background_light(object, direction);
  vec3 rgb = object_texel(object, 7).a > 0.5 ? light : to_display(light);
  blended = vec4(rgb, 1.0);
}
"""
_COMPOSITE_FRAGMENT = """
/* swag_engine/splats/development.py; rows of the gains, with contrast, knee and whether to develop in w. */
vec3 developed(vec3 display) {
  if (to_blue.w < 0.5) { return display; }
  float contrast = to_red.w, knee = to_green.w;
  vec3 light = to_light(display);
  light = vec3(dot(to_red.rgb, light), dot(to_green.rgb, light), dot(to_blue.rgb, light));
  float peak = max(max(light.r, light.g), max(light.b, 1e-12));
  float curved = GREY * pow(peak / GREY, contrast);
  if (knee < 1.0) {
    float over = max(curved - knee, 0.0) / (1.0 - knee);
    curved = min(curved, knee) + (1.0 - knee) * over / (1.0 + over);
  }
  return to_display(light * (curved / peak));
}
void main() {
  vec4 found = texture(picture, place);
  if (found.a < 1e-4) { discard; }
  found.rgb = developed(found.rgb / found.a) * found.a;
  /* Blender blends this with a gamma. It comes out as blended in display values over the viewport's background. */
  vec3 behind = pow(background.rgb, vec3(GAMMA));
  vec3 wanted = pow(clamp(found.rgb + (1.0 - found.a) * background.rgb, 0.0, 1.0), vec3(GAMMA));
  vec3 darker = 1.0 - wanted / max(behind, vec3(1e-6));
  float alpha = clamp(max(found.a, max(darker.r, max(darker.g, darker.b))), 0.0, 1.0);
  light = vec4(wanted - (1.0 - alpha) * behind, alpha);
}
"""


class Shaders:
    """The four shaders, compiled: splats, scene depth, what is behind the splats, composite."""

    def __init__(self) -> None:
        self.splats = _compile(
            _SPLAT_VERTEX,
            _SPLAT_FRAGMENT,
            output="blended",
            samplers=("geometry", "harmonic_data", "states", "order", "objects"),
            varyings=(("VEC2", "place"), ("VEC4", "tint")),
            library=_WATER,
            has_view=True,
        )
        self.depth = _compile(
            _SCREEN_VERTEX,
            _DEPTH_FRAGMENT,
            samplers=("depths",),
            constants=tuple(("VEC4", name) for name in FLOOR_CONSTANTS),
            writes_depth=True,
        )
        self.background = _compile(
            _SCREEN_VERTEX,
            _BACKGROUND_FRAGMENT,
            output="blended",
            samplers=("objects",),
            library=_WATER,
            has_view=True,
            constants=(("INT", "water_object"), ("VEC4", "color")),
            depth="1.0",
        )
        self.composite = _compile(
            _SCREEN_VERTEX,
            _COMPOSITE_FRAGMENT,
            output="light",
            samplers=("picture",),
            constants=tuple(("VEC4", name) for name in ("background", *DEVELOPMENT_ROWS)),
            library=_TRANSFER,
        )


def _compile(
    vertex: str,
    fragment: str,
    *,
    samplers: tuple[str, ...],
    output: str = "",
    varyings: tuple[tuple[str, str], ...] = (("VEC2", "place"),),
    library: str = "",
    has_view: bool = False,
    constants: tuple[tuple[str, str], ...] = (),
    writes_depth: bool = False,
    depth: str = "0.0",
) -> gpu.types.GPUShader:
    info: Any = gpu.types.GPUShaderCreateInfo()
    for slot, name in enumerate(samplers):
        info.sampler(slot, "FLOAT_2D", name)
    if has_view:
        info.typedef_source(_VIEW)
        info.uniform_buf(0, "View", "view")
    for kind, name in constants:
        info.push_constant(kind, name)
    interface: Any = gpu.types.GPUStageInterfaceInfo("swag_" + "_".join(name for _, name in varyings))
    for kind, name in varyings:
        (interface.flat if name == "tint" else interface.smooth)(kind, name)
    info.vertex_in(0, "VEC2", "corner")
    info.vertex_out(interface)
    if output:
        info.fragment_out(0, "VEC4", output)
    if writes_depth:
        info.depth_write("ANY")
    for name, value in (
        ("SH_0", SH_0),
        *((f"SH_F{number}", factor) for number, factor in enumerate(SH_FACTORS)),
        ("BLUR", PIXEL_VARIANCE),
        ("LEAST_VARIANCE", LEAST_VARIANCE),
        ("LEAST_BLUR", LEAST_BLUR),
        ("LEAST", MIN_ALPHA),
        ("MOST", MAX_ALPHA),
        ("NEAR", NEAR),
        ("HIDDEN", HIDDEN_ALPHA),
        ("GEOMETRY", GEOMETRY_TEXELS),
        ("DEPTH", depth),
        ("GAMMA", OVERLAY_GAMMA),
        ("GREY", GREY),
        ("GRID_REACH", GRID_REACH),
    ):
        info.define(name, str(value))
    is_vertex_library = "texelFetch(order" in vertex
    info.vertex_source((library if is_vertex_library else "") + vertex)
    info.fragment_source(("" if is_vertex_library else library) + fragment)
    return gpu.shader.create_from_info(info)


def development_constants(development: Development) -> dict[str, tuple[float, ...]]:
    """The values of DEVELOPMENT_ROWS for a development."""
    fourth = (development.contrast, development.knee, float(development != NO_DEVELOPMENT))
    rows = development.gains.tolist()
    return {name: (*row, last) for name, row, last in zip(DEVELOPMENT_ROWS, rows, fourth, strict=True)}


def frustum_limits(projection: Any) -> tuple[float, float, float, float]:
    """Where x/z and y/z stop in the linearised projection: left, right, bottom, top, half the margin beyond the image.

    Args:
        projection: (4, 4) perspective matrix of OpenGL.
    """
    margin = FRUSTUM_MARGIN
    limits = []
    for axis in (0, 1):
        scale, shift = projection[axis][axis], projection[axis][2]
        limits += [(-margin + shift) / scale, (margin + shift) / scale]
    return limits[0], limits[1], limits[2], limits[3]


def floor_constants(
    projection: np.ndarray, to_view: np.ndarray, objects: tuple[float, float, float, float]
) -> dict[str, tuple[float, ...]]:
    """Constants that tell the depth shader where the world's floor z = 0 is, and which objects may lie in it.

    With the floor's points as v = (X, Y, 1), the rows x, y and w of the projection are an invertible matrix H of v. So
    v is H^-1 (x/w, y/w, 1) times w, and the depth of a plane is linear in the place of a pixel:
    z/w = (row z) H^-1 (x/w, y/w, 1).

    Args:
        projection: (4, 4) of OpenGL.
        to_view: (4, 4) from the world to the view.
        objects: least x and y, and largest x and y, of the place in the floor where objects may be.

    Returns:
        Values by names of `FLOOR_CONSTANTS`: of the depth, factors of x, y and 1, with x and y from -1 to 1, and its
        tolerance as a fraction of 1 - depth; only zeros where the floor is seen from its edge.
    """
    rows = (projection @ to_view)[:, [0, 1, 3]]
    try:
        to_floor = np.linalg.inv(rows[[0, 1, 3]])
    except np.linalg.LinAlgError:
        return NO_FLOOR
    x, y, one = rows[2] @ to_floor
    depth = x / 2, y / 2, one / 2 + 0.5, 1e-6 if projection[3, 3] == 1 else FLOOR_TOLERANCE
    return dict(zip(FLOOR_CONSTANTS, (depth, *((*row, 0.0) for row in to_floor), objects), strict=True))
