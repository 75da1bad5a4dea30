// The real spherical harmonics up to degree 3 of a unit direction.
fn basis_at(d: vec3f) -> array<f32, 16> {
    let x = d.x; let y = d.y; let z = d.z; let xx = x * x; let yy = y * y; let zz = z * z;
    const c1 = 0.4886025119029199; const c2 = 1.0925484305920792; const c3 = 0.5900435899266435; const c4 = 0.4570457994644658;
    return array<f32, 16>(
        0.28209479177387814, -c1 * y, c1 * z, -c1 * x,
        c2 * x * y, -c2 * y * z, 0.31539156525252005 * (2.0 * zz - xx - yy), -c2 * x * z, 0.5462742152960396 * (xx - yy),
        -c3 * y * (3.0 * xx - yy), 2.890611442640554 * x * y * z, -c4 * y * (4.0 * zz - xx - yy),
        0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy), -c4 * x * (4.0 * zz - xx - yy),
        1.445305721320277 * z * (xx - yy), -c3 * x * (xx - 3.0 * yy));
}
