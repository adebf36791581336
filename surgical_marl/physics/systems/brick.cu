// The finite element of brick.py: its rotation, the forces on its nodes, and how these fall as nodes move.
// Numbers in capitals are of the material and the grid.
struct Vector {
    static __device__ float dot(const float *x, const float *y) { return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]; }
    static __device__ void cross(const float *x, const float *y, float *z) {
        z[0] = x[1] * y[2] - x[2] * y[1];
        z[1] = x[2] * y[0] - x[0] * y[2];
        z[2] = x[0] * y[1] - x[1] * y[0];
    }
    static __device__ float size(const float *x) { return sqrtf(fmaxf(dot(x, x), 1e-24f)); }
};

// Symmetric matrices have their lower halves, row by row: xx, xy, yy, xz, yz, zz.
struct Symmetric {
    static __device__ void times(const float *m, const float *x, float *y) {
        y[0] = m[0] * x[0] + m[1] * x[1] + m[3] * x[2];
        y[1] = m[1] * x[0] + m[2] * x[1] + m[4] * x[2];
        y[2] = m[3] * x[0] + m[4] * x[1] + m[5] * x[2];
    }
    static __device__ void cofactors(const float *m, float *c) {
        c[0] = m[2] * m[5] - m[4] * m[4];
        c[1] = m[4] * m[3] - m[1] * m[5];
        c[2] = m[0] * m[5] - m[3] * m[3];
        c[3] = m[1] * m[4] - m[2] * m[3];
        c[4] = m[3] * m[1] - m[0] * m[4];
        c[5] = m[0] * m[2] - m[1] * m[1];
    }
    static __device__ float determinant(const float *m, const float *c) { return m[0] * c[0] + m[1] * c[1] + m[3] * c[3]; }
    static __device__ void invert(const float *m, float *found) {
        cofactors(m, found);
        const float scale = 1.0f / fmaxf(determinant(m, found), 1e-6f);
        for (int i = 0; i < 6; i++) found[i] *= scale;
    }
};

struct Brick {
    float turn[9], spin[6], crush[6];

    static __device__ float slope(int axis) { return axis == 0 ? SLOPE_X : axis == 1 ? SLOPE_Y : SLOPE_Z; }
    static __device__ int mode(int axis) { return 4 >> axis; }  // of the gradient along an axis

    // Values at nodes become modes, and forces of modes those on nodes.
    static __device__ void to_modes(float *x) {
        UNROLL
        for (int i = 0; i < 24; i++) x[i] *= 0.125f;
        UNROLL
        for (int bit = 4; bit > 0; bit /= 2)
            UNROLL
            for (int node = 0; node < 8; node++)
                UNROLL
                for (int i = 0; i < 3; i++)
                    if (!(node & bit)) {
                        const float low = x[3 * node + i], high = x[3 * (node + bit) + i];
                        x[3 * node + i] = low + high;
                        x[3 * (node + bit) + i] = low - high;
                    }
    }

    static __device__ void gradient(const float *modes, float *found) {
        UNROLL
        for (int i = 0; i < 3; i++)
            UNROLL
            for (int j = 0; j < 3; j++) found[3 * i + j] = modes[3 * mode(j) + i] * slope(j);
    }

    // The frame's transpose times a matrix.
    __device__ void inward(const float *matrix, float *found) const {
        UNROLL
        for (int i = 0; i < 3; i++)
            UNROLL
            for (int j = 0; j < 3; j++)
                found[3 * i + j] = turn[i] * matrix[j] + turn[3 + i] * matrix[3 + j] + turn[6 + i] * matrix[6 + j];
    }

    // Displacements of the hourglass modes in its frame.
    __device__ void warp(const float *modes, float *found) const {
        UNROLL
        for (int i = 0; i < 3; i++) {
            found[i] = modes[9] * turn[i] + modes[10] * turn[3 + i] + modes[11] * turn[6 + i];
            UNROLL
            for (int k = 1; k < 4; k++)
                found[3 * k + i] = modes[12 + 3 * k] * turn[i] + modes[13 + 3 * k] * turn[3 + i] + modes[14 + 3 * k] * turn[6 + i];
        }
    }

    static __device__ void resist(const float *warped, float *found) {
        HOURGLASS(warped, found)
    }

    // Forces on nodes of a stress times the volume, [3, 3], and of forces of the hourglass modes, times a factor.
    __device__ void spread(const float *stress, const float *hourglass, float factor, float *forces) const {
        UNROLL
        for (int i = 0; i < 3; i++) {
            const float *row = turn + 3 * i;
            forces[i] = 0.0f;
            UNROLL
            for (int j = 0; j < 3; j++)
                forces[3 * mode(j) + i] = factor * slope(j) * (row[0] * stress[j] + row[1] * stress[3 + j] + row[2] * stress[6 + j]);
            forces[9 + i] = factor * Vector::dot(row, hourglass);
            UNROLL
            for (int k = 1; k < 4; k++) forces[12 + 3 * k + i] = factor * Vector::dot(row, hourglass + 3 * k);
        }
        to_modes(forces);
    }

    // The rotation nearest to a gradient, by Newton's method from one of nearly equal stretches.
    __device__ void rotate(const float *gradient) {
        float even[9], c[9];
        UNROLL
        for (int i = 0; i < 9; i++) even[i] = gradient[i];
        for (int step = 0; step < EVENED; step++) {
            Vector::cross(even + 3, even + 6, c);
            Vector::cross(even + 6, even, c + 3);
            Vector::cross(even, even + 3, c + 6);
            const float own = Vector::dot(even, even) + Vector::dot(even + 3, even + 3) + Vector::dot(even + 6, even + 6);
            const float other = Vector::dot(c, c) + Vector::dot(c + 3, c + 3) + Vector::dot(c + 6, c + 6);
            const float by = 1.0f / sqrtf(fmaxf(own, 1e-24f)), across = 1.0f / sqrtf(fmaxf(other, 1e-24f));
            UNROLL
            for (int i = 0; i < 9; i++) even[i] = by * even[i] + across * c[i];
        }
        float first[3] = {even[0], even[3], even[6]}, second[3] = {even[1], even[4], even[7]}, third[3];
        const float length = 1.0f / Vector::size(first);
        for (int i = 0; i < 3; i++) first[i] *= length;
        Vector::cross(first, second, third);
        const float other = 1.0f / Vector::size(third);
        for (int i = 0; i < 3; i++) third[i] *= other;
        Vector::cross(third, first, second);
        for (int i = 0; i < 3; i++) turn[3 * i] = first[i], turn[3 * i + 1] = second[i], turn[3 * i + 2] = third[i];
        for (int step = 0; step < NEWTON; step++) {
            float s[9], slow[6], half[3];
            inward(gradient, s);
            const float skew[3] = {s[7] - s[5], s[2] - s[6], s[3] - s[1]};
            unturned(s, slow);
            Symmetric::times(slow, skew, half);
            for (int i = 0; i < 3; i++) half[i] *= 0.5f;
            const float least = 1.0f / fmaxf(1.0f, Vector::size(half));
            for (int i = 0; i < 3; i++) half[i] *= least;
            const float w = 1.0f / sqrtf(1.0f + Vector::dot(half, half)), x = w * half[0], y = w * half[1], z = w * half[2];
            const float by[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
                                 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                                 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)};
            for (int i = 0; i < 3; i++) {
                const float row[3] = {turn[3 * i], turn[3 * i + 1], turn[3 * i + 2]};
                for (int j = 0; j < 3; j++) turn[3 * i + j] = row[0] * by[j] + row[1] * by[3 + j] + row[2] * by[6 + j];
            }
        }
    }

    // By how much the brick turns by the skew part of a change of its gradient: the inverse of tr(S) 1 - S.
    static __device__ void unturned(const float *s, float *found) {
        const float m[6] = {s[4] + s[8], -0.5f * (s[1] + s[3]), s[0] + s[8],
                            -0.5f * (s[2] + s[6]), -0.5f * (s[5] + s[7]), s[0] + s[4]};
        Symmetric::invert(m, found);
    }

    // Makes the brick of its nodes [8, 3], and turns these into the forces on them, times a factor.
    __device__ void deform(float *x, float factor) {
        float gradient[9], s[9], stretch[6], cofactors[6], slow[6], warped[12], resists[12];
        to_modes(x);
        Brick::gradient(x, gradient);
        rotate(gradient);
        inward(gradient, s);
        stretch[0] = s[0], stretch[1] = 0.5f * (s[1] + s[3]), stretch[2] = s[4];
        stretch[3] = 0.5f * (s[2] + s[6]), stretch[4] = 0.5f * (s[5] + s[7]), stretch[5] = s[8];
        Symmetric::cofactors(stretch, cofactors);
        const float volume = Symmetric::determinant(stretch, cofactors), left = fmaxf(volume, CRUSHED / 8);
        const float lost = fmaxf(CRUSHED - volume, 0.0f) / left, pressure = RESISTANCE * lost * lost;
        const float stiff = sqrtf(2 * RESISTANCE * lost * CRUSHED) / left, grown = LAME * (s[0] + s[4] + s[8] - 3.0f);
        unturned(s, slow);
        warp(x, warped);
        resist(warped, resists);
        float moment[3] = {0.0f, 0.0f, 0.0f}, torque[3];
        for (int k = 0; k < 4; k++) {
            float own[3];
            Vector::cross(resists + 3 * k, warped + 3 * k, own);
            for (int i = 0; i < 3; i++) moment[i] += own[i];
        }
        Symmetric::times(slow, moment, torque);
        float q[6];
        for (int i = 0; i < 6; i++) {
            const bool diagonal = i == 0 || i == 2 || i == 5;
            q[i] = VOLUME * (2 * SHEAR * (stretch[i] - diagonal) + grown * diagonal - pressure * cofactors[i]);
            crush[i] = stiff * cofactors[i];
            spin[i] = SHEAR * diagonal + (grown - 2 * SHEAR) * slow[i];
        }
        const float x01 = fabsf(spin[1]), x02 = fabsf(spin[3]), x12 = fabsf(spin[4]);  // Gershgorin's circles
        spin[0] += fmaxf(x01 + x02 - spin[0], 0.0f);
        spin[2] += fmaxf(x01 + x12 - spin[2], 0.0f);
        spin[5] += fmaxf(x02 + x12 - spin[5], 0.0f);
        const float stress[9] = {q[0], q[1] - torque[2], q[3] + torque[1], q[1] + torque[2], q[2], q[4] - torque[0],
                                 q[3] - torque[1], q[4] + torque[0], q[5]};
        spread(stress, resists, -factor, x);
    }

    // Turns displacements of nodes [8, 3] into the fall of the forces on them, times a factor.
    __device__ void product(float *u, float factor) const {
        float gradient[9], s[9], warped[12], resists[12];
        to_modes(u);
        Brick::gradient(u, gradient);
        inward(gradient, s);
        warp(u, warped);
        resist(warped, resists);
        const float skew[3] = {s[7] - s[5], s[2] - s[6], s[3] - s[1]};
        const float shear[3] = {s[1] + s[3], s[2] + s[6], s[5] + s[7]};  // xy, xz, yz
        const float lost = crush[0] * s[0] + crush[2] * s[4] + crush[5] * s[8] + crush[1] * shear[0]
                         + crush[3] * shear[1] + crush[4] * shear[2];
        const float grown = LAME * (s[0] + s[4] + s[8]);
        float torque[3];
        Symmetric::times(spin, skew, torque);
        const float xy = SHEAR * shear[0] + lost * crush[1], xz = SHEAR * shear[1] + lost * crush[3];
        const float yz = SHEAR * shear[2] + lost * crush[4];
        const float stress[9] = {
            VOLUME * (2 * SHEAR * s[0] + grown + lost * crush[0]), VOLUME * (xy - torque[2]), VOLUME * (xz + torque[1]),
            VOLUME * (xy + torque[2]), VOLUME * (2 * SHEAR * s[4] + grown + lost * crush[2]), VOLUME * (yz - torque[0]),
            VOLUME * (xz - torque[1]), VOLUME * (yz + torque[0]), VOLUME * (2 * SHEAR * s[8] + grown + lost * crush[5])};
        spread(stress, resists, factor, u);
    }

    // The block of the matrix of a node and its opposite one, lower half, by those of opposite nodes 0 to 3, times a factor.
    __device__ void block(int node, float factor, float *found) const {
        const float sign[3] = {1.0f, node & 2 ? -1.0f : 1.0f, node & 1 ? -1.0f : 1.0f};
        const float own[6] = {DIAGONAL_XX, sign[1] * DIAGONAL_XY, DIAGONAL_YY,
                              sign[2] * DIAGONAL_XZ, sign[1] * sign[2] * DIAGONAL_YZ, DIAGONAL_ZZ};
        for (int i = 0; i < 3; i++) {
            float half[3];
            Symmetric::times(own, turn + 3 * i, half);
            for (int j = 0; j <= i; j++) found[i * (i + 1) / 2 + j] = factor * Vector::dot(half, turn + 3 * j);
        }
    }

    // The block of the matrix of the upper and the lower node of edge 0 or 1 along z, [3, 3], times a factor.
    __device__ void upright(int edge, float factor, float *found) const {
        const float sign = edge ? -1.0f : 1.0f;
        const float own[9] = {UPRIGHT_XX, sign * UPRIGHT_XY, UPRIGHT_XZ, sign * UPRIGHT_YX, UPRIGHT_YY,
                              sign * UPRIGHT_YZ, UPRIGHT_ZX, sign * UPRIGHT_ZY, UPRIGHT_ZZ};
        for (int i = 0; i < 3; i++) {
            float half[3];
            for (int j = 0; j < 3; j++) half[j] = factor * (turn[3 * i] * own[j] + turn[3 * i + 1] * own[3 + j] + turn[3 * i + 2] * own[6 + j]);
            for (int j = 0; j < 3; j++) found[3 * i + j] = Vector::dot(half, turn + 3 * j);
        }
    }

    // The volume of a brick of these nodes [8, 3], as a share of that at rest. Nodes become modes.
    static __device__ float volume(float *x) {
        float gradient[9], c[3];
        to_modes(x);
        Brick::gradient(x, gradient);
        Vector::cross(gradient + 3, gradient + 6, c);
        return Vector::dot(gradient, c);
    }
};
