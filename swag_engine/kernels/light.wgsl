// Display values and linear light (sRGB, IEC 61966-2-1): the value and its slope.
fn to_light(display: f32) -> vec2f {
    if (display <= DISPLAY_TOE) { return vec2f(display, 1.0) / 12.92; }
    let base = (display + 0.055) / 1.055;
    let power = pow(base, 1.4);
    return vec2f(power * base, power * (2.4 / 1.055));
}

fn to_display(light: f32) -> vec2f {
    if (light <= LINEAR_TOE) { return vec2f(light, 1.0) * 12.92; }
    let power = pow(light, 1.0 / 2.4);
    return vec2f(power * 1.055 - 0.055, power / light * (1.055 / 2.4));
}
