// The step of tissue_step.py's `respond`: bricks are linearised, then contacts, and conjugate gradients follow, in rounds.
__shared__ float force[3 * ROOM];

struct Contact {
    float normal[3], shift[3], stretch[3], depth, stiffness, sliding;
    bool both, holds;

    // Channel.py's `hold`, likewise: springs across what is in a channel, and friction along it.
    __device__ void hold(const float *moved, float *force, float *falls) const {
        float whole[3];
        for (int i = 0; i < 3; i++) whole[i] = stretch[i] + moved[i];
        const float slid = Vector::dot(normal, whole), most = slid < 0 ? sliding : fmaxf(depth, 0.0f);
        const float secant = fminf(stiffness, most / fmaxf(fabsf(slid), 1e-12f)), aside = depth < 0 ? 0.0f : stiffness;
        for (int i = 0, k = 0; i < 3; i++) {
            force[i] = -aside * (whole[i] - slid * normal[i]) - secant * slid * normal[i];
            for (int j = 0; j <= i; j++, k++) falls[k] = (i == j ? aside : 0.0f) + (secant - aside) * normal[i] * normal[j];
        }
    }

    // Spring_contact.py's `feel`: force and stiffness, lower half, of a point that moves by this much.
    __device__ void feel(const float *point, float *force, float *falls) const {
        float moved[3], slid[3];
        for (int i = 0; i < 3; i++) moved[i] = point[i] - shift[i];
        if (HOLDS >= 0 && holds) return hold(moved, force, falls);
        const float along = Vector::dot(normal, moved), reach = depth - along, off = Vector::dot(normal, stretch);
        const float pressing = stiffness * (both ? reach : fmaxf(reach, 0.0f));
        for (int i = 0; i < 3; i++) slid[i] = stretch[i] - normal[i] * off + moved[i] - normal[i] * along;
        const float secant = both ? stiffness : fminf(stiffness, sliding * pressing / Vector::size(slid));
        const float pressed = both || reach > 0 ? stiffness : 0.0f;
        for (int i = 0, k = 0; i < 3; i++) {
            force[i] = pressing * normal[i] - secant * slid[i];
            for (int j = 0; j <= i; j++, k++) falls[k] = (i == j ? secant : 0.0f) + (pressed - secant) * normal[i] * normal[j];
        }
    }
};

const auto contact = [&](int c) {
    Contact own;
    for (int i = 0; i < 3; i++) {
        own.normal[i] = in.ends_rows_normal[3 * c + i];
        own.shift[i] = in.ends_rows_shift[3 * c + i];
        own.stretch[i] = in.ends_rows_stretch[3 * c + i];
    }
    own.depth = in.ends_rows_depth[c], own.stiffness = in.ends_rows_stiffness[c], own.sliding = in.ends_rows_sliding[c];
    own.both = in.ends_rows_bilateral[c], own.holds = false;
    if (HOLDS >= 0) {
        const int part = in.ends_rows_part[c];
        own.both = own.both && part < HOLDS, own.holds = part >= HOLDS && part < PRESSES;
    }
    return own;
};
const int rows = in.ends_total[0], moving = in.ends_moving[0];

// Springs of other systems on the skin come after the contacts.
int springs = rows;
const auto bear = [&](const auto &points, const auto &shares, const auto &pushes, const auto &falls, int used) {
    const int held = points.size * 3 / pushes.size;
    for (int k = thread; k < HELD * used; k += threads) {
        const int c = k / HELD, own = k % HELD;
        nodes[HELD * springs + k] = own < held ? (short)points[held * c + own] : 0;
        weights[HELD * springs + k] = own < held ? shares[held * c + own] : 0.0f;
    }
    for (int k = thread; k < 6 * used; k += threads) stiffness[6 * springs + k] = falls[k];
    for (int k = thread; k < 3 * used; k += threads) force[3 * springs + k] = pushes[k];
    springs += used;
};
hold(rows);
BEAR_LOADS
hang(springs);
// What springs of others pull at displacements p, and what contacts do.
const auto pulls = [&](int begin) {
    for (int c = begin + thread; c < springs; c += threads) {
        float moved[3], falls[3];
        Block::point(p, nodes + HELD * c, weights + HELD * c, moved);
        Symmetric::times(stiffness + 6 * c, moved, falls);
        for (int i = 0; i < 3; i++) pull[3 * c + i] = force[3 * c + i] - falls[i];
    }
};
linearise();
// forces of all but bricks, without contacts, that inertia does not balance at displacements u
const auto unbalanced = [&](int a, int n, float *found) {
    const float mass = in.mesh_mass[n], support = in.mesh_support[n];
    for (int i = 0; i < 3; i++)
        found[i] = mass * (in.nodes_velocity[3 * n + i] / DT + (i == 2 ? GRAVITY : 0.0f))
                 - support * (in.nodes_position[3 * n + i] - in.mesh_rest[3 * n + i]) - inertia[a] * u[a][i];
};
EACH_NODE(a, n) {
    for (int i = 0; i < 3; i++) u[a][i] = free[a] * DT * in.nodes_velocity[3 * n + i];
    unbalanced(a, n, residual[a]);
    add_bricks(n, residual[a]);
}
__syncthreads();
assemble();
EACH_NODE(a, n)
    for (int i = 0; i < 3; i++) p[3 * n + i] = u[a][i];
__syncthreads();
bricks_times();
__syncthreads();
EACH_NODE(a, n) {
    float falls[3] = {0.0f, 0.0f, 0.0f};
    add_bricks(n, falls);
    for (int i = 0; i < 3; i++) residual[a][i] -= falls[i];
}

const int rounds = springs > 0 ? ROUNDS : 1, iterations = springs > 0 ? TURNS : ALONE;
pulls(rows);
for (int round = 0; round < rounds; round++) {
    // contacts anew: by how much their forces differ from those in the residual
    for (int c = thread; c < rows; c += threads) {
        const Contact own = contact(c);
        float moved[3], was[3] = {0.0f, 0.0f, 0.0f}, felt[3];
        Block::point(p, nodes + HELD * c, weights + HELD * c, moved);
        if (round > 0) {
            Symmetric::times(stiffness + 6 * c, moved, was);
            for (int i = 0; i < 3; i++) was[i] = force[3 * c + i] - was[i];
        }
        own.feel(moved, felt, stiffness + 6 * c);
        Symmetric::times(stiffness + 6 * c, moved, force + 3 * c);
        for (int i = 0; i < 3; i++) {
            pull[3 * c + i] = felt[i] - was[i];
            force[3 * c + i] += felt[i];
        }
    }
    __syncthreads();
    EACH_NODE(a, n) add_pulls(n, residual[a]);
    improve(springs, iterations, ENOUGH);
    for (int k = 3 * rows + thread; k < 3 * springs; k += threads) pull[k] = 0.0f;  // in the residual from now on
}
if (LOOSE) {
    float left[NODES_EACH][3];
    pulls(0);
    __syncthreads();
    EACH_NODE(a, n) {
        unbalanced(a, n, left[a]);
        add_pulls(n, left[a]);
    }
    balance(left, springs);
}

shorten();
for (int k = thread; k < 3 * NODES; k += threads) out.shift[k] = p[k];
for (int c = thread; c < rows; c += threads) {
    float moved[3], felt[3], eased[6] = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f};
    const float *falls = stiffness + 6 * c;
    Block::point(p, nodes + HELD * c, weights + HELD * c, moved);
    Symmetric::times(falls, moved, felt);
    for (int i = 0; i < 3; i++) out.force[3 * c + i] = force[3 * c + i] - felt[i];
    if (c < moving) {
        const float direction[3] = {in.ends_rows_normal[3 * c], in.ends_rows_normal[3 * c + 1], in.ends_rows_normal[3 * c + 2]};
        float give = 0.0f, along[3];
        for (int k = 0; k < HELD; k++) {
            const int node = nodes[HELD * c + k];
            const float weight = weights[HELD * c + k];
            give += weight * weight * in.mesh_free[node] / Block::mean(block + 6 * node);
        }
        Symmetric::times(falls, direction, along);
        float normal = Vector::dot(direction, along), slides = (falls[0] + falls[2] + falls[5] - normal) / 2;
        normal /= 1 + normal * ACROSS * give;
        slides /= 1 + slides * BESIDE * give;
        for (int i = 0, k = 0; i < 3; i++)
            for (int j = 0; j <= i; j++, k++) eased[k] = (i == j ? slides : 0.0f) + (normal - slides) * direction[i] * direction[j];
    }
    for (int i = 0; i < 6; i++) out.falls[6 * c + i] = eased[i];
}
