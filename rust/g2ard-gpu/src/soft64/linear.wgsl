// Small dense linear algebra, operation by operation as in g2ard_core::linalg.

// Symmetric, both halves kept; rows of `v` are the eigenvectors of `values`, which descend.
struct Eigen {
    values: array<F64, 3>,
    vectors: array<array<F64, 3>, 3>,
}

const HUNDRED = F64(0u, 0x40590000u);
const HALF = F64(0u, 0x3fe00000u);
// 1e150: beyond, θ² would overflow.
const STEEP = F64(0x2e5096afu, 0x5f138d35u);

// Below the last digit of `beside`.
fn vanishes(small: F64, beside: F64) -> bool {
    return all(add(beside, small) == beside);
}

// symmetric_eigen: cyclic Jacobi.
fn symmetric_eigen(m: array<F64, 6>) -> Eigen {
    var a = array<array<F64, 3>, 3>(
        array<F64, 3>(m[0], m[1], m[2]),
        array<F64, 3>(m[1], m[3], m[4]),
        array<F64, 3>(m[2], m[4], m[5]),
    );
    var v = array<array<F64, 3>, 3>(
        array<F64, 3>(ONE, ZERO, ZERO),
        array<F64, 3>(ZERO, ONE, ZERO),
        array<F64, 3>(ZERO, ZERO, ONE),
    );
    for (var step = 0; step < 96; step++) {
        let turn = step % 3;
        if turn == 0 && is_zero(a[0][1]) && is_zero(a[0][2]) && is_zero(a[1][2]) { break; }
        let p = select(0, 1, turn == 2);
        let q = select(2, 1, turn == 0);
        let r = 3 - p - q;
        let apq = a[p][q];
        let small = mul(HUNDRED, mag(apq));
        if vanishes(small, mag(a[p][p])) && vanishes(small, mag(a[q][q])) {
            a[p][q] = ZERO;
            a[q][p] = ZERO;
            continue;
        }
        let theta = div(sub(a[q][q], a[p][p]), mul(TWO, apq));
        let steep = lt(STEEP, mag(theta));
        var t = F64(ONE.x, ONE.y | (theta.y & 0x80000000u));
        var by = add(mag(theta), root(add(mul(theta, theta), ONE)));
        if steep {
            t = HALF;
            by = theta;
        }
        t = div(t, by);
        let c = div(ONE, root(add(mul(t, t), ONE)));
        let s = mul(t, c);
        let shift = mul(t, apq);
        a[p][p] = sub(a[p][p], shift);
        a[q][q] = add(a[q][q], shift);
        a[p][q] = ZERO;
        a[q][p] = ZERO;
        // One loop for the three columns of v and for the row of a that the rotation leaves.
        for (var i = 0; i < 4; i++) {
            var x = a[r][p];
            var y = a[r][q];
            if i < 3 {
                x = v[p][i];
                y = v[q][i];
            }
            let turned_x = sub(mul(c, x), mul(s, y));
            let turned_y = add(mul(s, x), mul(c, y));
            if i < 3 {
                v[p][i] = turned_x;
                v[q][i] = turned_y;
            } else {
                a[r][p] = turned_x;
                a[r][q] = turned_y;
                a[p][r] = turned_x;
                a[q][r] = turned_y;
            }
        }
    }
    // Stable, descending.
    var order = array<i32, 3>(0, 1, 2);
    for (var round = 0; round < 3; round++) {
        let at = round % 2;
        let x = order[at];
        let y = order[at + 1];
        if total_lt(a[x][x], a[y][y]) {
            order[at] = y;
            order[at + 1] = x;
        }
    }
    var e: Eigen;
    for (var k = 0; k < 3; k++) {
        e.values[k] = a[order[k]][order[k]];
        e.vectors[k] = v[order[k]];
    }
    return e;
}
