// One number's step of Adam (arXiv 1412.6980), as in adam.cu: its new moments and value.
struct Moved { value: f32, mean: f32, square: f32 }

fn adam_of(old: Moved, g: f32, step_size: f32, root: f32, weight1: f32, weight2: f32, epsilon: f32) -> Moved {
    let m = old.mean + weight1 * (g - old.mean);
    let s = old.square + weight2 * (g * g - old.square);
    return Moved(old.value - step_size * m / (sqrt(s) / root + epsilon), m, s);
}
