// The real spherical harmonics up to degree 3 of a unit direction.
fn basis_at(d: vec3f) -> array<f32, 16> {
    let x = d.x; let y = d.y; let z = d.z; let xx = x * x; let yy = y * y; let zz = z * z;
    const c1 = SH_C1; const c2 = SH_C2_0; const c3 = SH_C3_0; const c4 = SH_C3_2;
    return array<f32, 16>(
        SH_C0, -c1 * y, c1 * z, -c1 * x,
        c2 * x * y, -c2 * y * z, SH_C2_1 * (2.0 * zz - xx - yy), -c2 * x * z, SH_C2_2 * (xx - yy),
        -c3 * y * (3.0 * xx - yy), SH_C3_1 * x * y * z, -c4 * y * (4.0 * zz - xx - yy),
        SH_C3_3 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy), -c4 * x * (4.0 * zz - xx - yy),
        SH_C3_4 * z * (xx - yy), -c3 * x * (xx - 3.0 * yy));
}
