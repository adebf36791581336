// The step of tissue_step.py's `respond`: bricks are linearised, then contacts, and conjugate gradients follow, in rounds.
__shared__ float p[3 * NODES], each[PAD * BRICKS], right[3 * NODES], block[6 * NODES];
__shared__ float force[3 * ROOM], stiffness[6 * ROOM], pull[3 * ROOM], weights[HELD * ROOM], box[2][64];
__shared__ int nodes[HELD * ROOM];
__shared__ short first[NODES], next[HELD * ROOM];

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
const float stiffer = in.stiffer[0], blend = stiffer * BLEND;
const int rows = in.ends_total[0], moving = in.ends_moving[0];
Brick brick[BRICKS_EACH];
int corner[BRICKS_EACH];
float u[NODES_EACH][3], residual[NODES_EACH][3], inverse[NODES_EACH][6], inertia[NODES_EACH], free[NODES_EACH];

for (int k = thread; k < HELD * rows; k += threads) nodes[k] = in.held_nodes[k], weights[k] = in.held_weights[k];
for (int k = thread; k < 3 * NODES; k += threads) p[k] = in.nodes_position[k];
__syncthreads();

// forces at the start, and each node's own block of the matrix
EACH(a, e, BRICKS) {
    float x[24];
    corner[a] = 3 * in.mesh_bricks[e];
    Block::corners(p + corner[a], x);
    brick[a].deform(x, stiffer);
    for (int i = 0; i < 24; i++) each[PAD * e + i] = x[i];
}
__syncthreads();
EACH(a, n, NODES) {
    const float mass = in.mesh_mass[n], support = in.mesh_support[n];
    free[a] = in.mesh_free[n];
    inertia[a] = mass / (DT * DT) + support;
    Hung::link(nodes, weights, rows, n, first, next);
    for (int i = 0; i < 3; i++) {
        const float v = in.nodes_velocity[3 * n + i];
        float sum = mass * (v / DT + (i == 2 ? GRAVITY : 0.0f)) - support * (p[3 * n + i] - in.mesh_rest[3 * n + i]);
        for (int k = 0; k < 8; k++) {
            const int at = in.mesh_around[8 * n + k];
            if (at >= 0) sum += each[at + i];
        }
        right[3 * n + i] = sum;
        u[a][i] = free[a] * DT * v;
    }
}
__syncthreads();
EACH(a, e, BRICKS)
    for (int node = 0; node < 4; node++) brick[a].block(node, blend, each + PAD * e + 6 * node);
__syncthreads();
EACH(a, n, NODES) {
    float sum[6] = {inertia[a], 0.0f, inertia[a], 0.0f, 0.0f, inertia[a]};
    for (int k = 0; k < 8; k++) {
        const int at = in.mesh_around[8 * n + k];
        const int pair = at % PAD / 3, own = at - at % PAD + 6 * (pair < 4 ? pair : 7 - pair);
        if (at >= 0)
            for (int i = 0; i < 6; i++) sum[i] += each[own + i];
    }
    for (int i = 0; i < 6; i++) block[6 * n + i] = sum[i];
    for (int i = 0; i < 3; i++) p[3 * n + i] = u[a][i];
}
__syncthreads();

// what bricks add to the matrix times p; after a barrier, its sum over the bricks around a node
const auto bricks_times = [&]() {
    EACH(a, e, BRICKS) {
        float x[24];
        Block::corners(p + corner[a], x);
        brick[a].product(x, blend);
        for (int i = 0; i < 24; i++) each[PAD * e + i] = x[i];
    }
};
const auto add_bricks = [&](int n, float *sum) {
    for (int k = 0; k < 8; k++) {
        const int at = in.mesh_around[8 * n + k];
        if (at >= 0)
            for (int i = 0; i < 3; i++) sum[i] += each[at + i];
    }
};
const auto add_pulls = [&](int n, float *sum) {
    for (int k = first[n]; k >= 0; k = next[k])
        for (int i = 0; i < 3; i++) sum[i] += weights[k] * pull[3 * (k / HELD) + i];
};

const int rounds = rows > 0 ? ROUNDS : 1, iterations = rows > 0 ? TURNS : ALONE;
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
    if (round == 0) bricks_times();
    __syncthreads();
    float z[NODES_EACH][3], rz[2] = {0.0f, 0.0f};
    EACH(a, n, NODES) {
        if (round == 0) {
            float sum[3];
            for (int i = 0; i < 3; i++) sum[i] = inertia[a] * p[3 * n + i];
            add_bricks(n, sum);
            for (int i = 0; i < 3; i++) residual[a][i] = right[3 * n + i] - sum[i];
        }
        add_pulls(n, residual[a]);
        float sum[6];
        for (int i = 0; i < 6; i++) sum[i] = block[6 * n + i];
        for (int k = first[n]; k >= 0; k = next[k])
            for (int i = 0; i < 6; i++) sum[i] += weights[k] * weights[k] * stiffness[6 * (k / HELD) + i];
        for (int i = 0; i < 3; i++) residual[a][i] *= free[a];
        Symmetric::invert(sum, inverse[a]);
        Symmetric::times(inverse[a], residual[a], z[a]);
        rz[0] += Vector::dot(residual[a], z[a]);
    }
    Block::sum(rz, box[1]);
    EACH(a, n, NODES) {
        for (int i = 0; i < 3; i++) p[3 * n + i] = z[a][i];
    }
    __syncthreads();

    // conjugate gradients
    for (int iteration = 0; iteration < iterations && rz[0] > ENOUGH; iteration++) {
        bricks_times();
        for (int c = thread; c < rows; c += threads) {
            float moved[3];
            Block::point(p, nodes + HELD * c, weights + HELD * c, moved);
            Symmetric::times(stiffness + 6 * c, moved, pull + 3 * c);
        }
        __syncthreads();
        float ap[NODES_EACH][3], pap[2] = {0.0f, 0.0f}, after[2] = {0.0f, 0.0f};
        EACH(a, n, NODES) {
            const float *own = p + 3 * n;
            for (int i = 0; i < 3; i++) ap[a][i] = inertia[a] * own[i];
            add_bricks(n, ap[a]);
            add_pulls(n, ap[a]);
            for (int i = 0; i < 3; i++) ap[a][i] *= free[a];
            pap[0] += Vector::dot(own, ap[a]);
            pap[1] += inertia[a] * Vector::dot(own, own);
        }
        Block::sum(pap, box[0]);
        const float length = rz[0] / fmaxf(fmaxf(pap[0], pap[1]), 1e-30f);
        EACH(a, n, NODES) {
            for (int i = 0; i < 3; i++) {
                u[a][i] += length * p[3 * n + i];
                residual[a][i] -= length * ap[a][i];
            }
            Symmetric::times(inverse[a], residual[a], z[a]);
            after[0] += Vector::dot(residual[a], z[a]);
        }
        Block::sum(after, box[1]);
        const float share = after[0] / fmaxf(rz[0], 1e-30f);
        EACH(a, n, NODES) {
            for (int i = 0; i < 3; i++) p[3 * n + i] = z[a][i] + share * p[3 * n + i];
        }
        rz[0] = after[0];
        __syncthreads();
    }
    EACH(a, n, NODES) {
        for (int i = 0; i < 3; i++) p[3 * n + i] = u[a][i];
    }
    __syncthreads();
}

for (int k = thread; k < 3 * NODES; k += threads) out.shift[k] = p[k];
for (int c = thread; c < rows; c += threads) {
    float moved[3], felt[3], falls[6], along[3], eased[6] = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f}, gives[HELD] = {};
    Block::point(p, nodes + HELD * c, weights + HELD * c, moved);
    Symmetric::times(stiffness + 6 * c, moved, felt);
    for (int i = 0; i < 3; i++) out.force[3 * c + i] = force[3 * c + i] - felt[i];
    if (c < moving) {
        const Contact own = contact(c);
        own.feel(moved, felt, falls);
        float soft = 0.0f;
        for (int k = 0; k < HELD; k++) {
            const int node = nodes[HELD * c + k];
            gives[k] = weights[HELD * c + k] * in.mesh_free[node] / Block::mean(block + 6 * node);
            soft += weights[HELD * c + k] * gives[k];
        }
        Symmetric::times(falls, own.normal, along);
        float normal = Vector::dot(own.normal, along), slides = (falls[0] + falls[2] + falls[5] - normal) / 2;
        normal /= 1 + normal * soft;
        slides /= 1 + slides * soft;
        for (int i = 0, k = 0; i < 3; i++)
            for (int j = 0; j <= i; j++, k++)
                eased[k] = (i == j ? slides : 0.0f) + (normal - slides) * own.normal[i] * own.normal[j];
    }
    for (int i = 0; i < 6; i++) out.falls[6 * c + i] = eased[i];
    for (int k = 0; k < HELD; k++) out.gives[HELD * c + k] = gives[k];
}
