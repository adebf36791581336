// The linear equations of a step of brick_solve.py, and conjugate gradients for them.
// A thread keeps its bricks, and of its nodes all but p. Contacts are springs at points of the tissue.
__shared__ float p[3 * NODES], each[PAD * BRICKS], block[6 * NODES], box[2][64], rigid[28];
__shared__ float stiffness[6 * ROOM], pull[3 * ROOM], weights[HELD * ROOM];
__shared__ short nodes[HELD * ROOM], first[NODES], next[HELD * ROOM];
const float stiffer = in.stiffer[0], blend = stiffer * BLEND;
Brick brick[BRICKS_EACH];
int corner[BRICKS_EACH];
float u[NODES_EACH][3], residual[NODES_EACH][3], inertia[NODES_EACH], free[NODES_EACH];
float inverse[NODES_EACH][6], upright[NODES_EACH][9];

// The nodes of the contacts.
const auto hold = [&](int rows) {
    for (int k = thread; k < HELD * rows; k += threads) nodes[k] = (short)in.held_nodes[k], weights[k] = in.held_weights[k];
};
// Of each node the springs that hang on it.
const auto hang = [&](int springs) {
    __syncthreads();
    EACH_NODE(a, n) Hung::link(nodes, weights, springs, n, first, next);
};
const auto add_pulls = [&](int n, float *sum) {
    for (int k = first[n]; k >= 0; k = next[k])
        for (int i = 0; i < 3; i++) sum[i] += weights[k] * pull[3 * (k / HELD) + i];
};
// The sum over the bricks around a node of 3 numbers that they have for it in `each`.
const auto add_bricks = [&](int n, float *sum) {
    for (int k = 0; k < 8; k++) {
        const int at = in.mesh_around[8 * n + k];
        if (at >= 0)
            for (int i = 0; i < 3; i++) sum[i] += each[at + i];
    }
};

// Bricks, and in `each` their forces; then inertia, and the blocks of columns.
const auto linearise = [&]() {
    for (int k = thread; k < 3 * NODES; k += threads) p[k] = in.nodes_position[k];
    __syncthreads();
    EACH(a, e, BRICKS) {
        float x[24];
        corner[a] = 3 * in.mesh_bricks[e];
        Block::corners(p + corner[a], x);
        brick[a].deform(x, stiffer);
        for (int i = 0; i < 24; i++) each[PAD * e + i] = x[i];
    }
    EACH_NODE(a, n) {
        free[a] = in.mesh_free[n];
        inertia[a] = in.mesh_mass[n] / (DT * DT) + in.mesh_support[n];
    }
    __syncthreads();
};
const auto assemble = [&]() {
    EACH(a, e, BRICKS)
        for (int node = 0; node < 4; node++) brick[a].block(node, blend, each + PAD * e + 6 * node);
    __syncthreads();
    EACH_NODE(a, n) {
        float sum[6] = {inertia[a], 0.0f, inertia[a], 0.0f, 0.0f, inertia[a]};
        for (int k = 0; k < 8; k++) {
            const int at = in.mesh_around[8 * n + k];
            const int pair = at % PAD / 3, own = at - at % PAD + 6 * (pair < 4 ? pair : 7 - pair);
            if (at >= 0)
                for (int i = 0; i < 6; i++) sum[i] += each[own + i];
        }
        for (int i = 0; i < 6; i++) block[6 * n + i] = sum[i];
    }
    __syncthreads();
    EACH(a, e, BRICKS)
        for (int edge = 0; edge < 2; edge++) brick[a].upright(edge, blend, each + PAD * e + 9 * edge);
    __syncthreads();
    EACH_NODE(a, n) {
        for (int i = 0; i < 9; i++) upright[a][i] = 0.0f;
        if (a % LEVELS == 0) continue;
        const float linked = free[a] * free[a - 1];
        for (int k = 1; k < 8; k += 2) {  // opposite edges have each other's transpose
            const int at = in.mesh_around[8 * n + k], edge = k / 2, own = at - 3 * k + 9 * (edge < 2 ? edge : 3 - edge);
            if (at >= 0)
                for (int i = 0; i < 3; i++)
                    for (int j = 0; j < 3; j++) upright[a][3 * i + j] += linked * each[own + (edge < 2 ? 3 * i + j : 3 * j + i)];
        }
    }
    __syncthreads();
};

// What bricks add to the matrix times p; after a barrier, `add_bricks` has the sum.
const auto bricks_times = [&]() {
    EACH(a, e, BRICKS) {
        float x[24];
        Block::corners(p + corner[a], x);
        brick[a].product(x, blend);
        for (int i = 0; i < 24; i++) each[PAD * e + i] = x[i];
    }
};

// Adds to u by conjugate gradients from the residual, with the springs of so many contacts; p becomes u.
const auto improve = [&](int springs, int most, float enough) {
    float z[NODES_EACH][3], rz[2] = {0.0f, 0.0f};
    EACH_NODE(a, n) {
        float own[6];
        for (int i = 0; i < 6; i++) own[i] = block[6 * n + i];
        if (springs > 0)
            for (int k = first[n]; k >= 0; k = next[k])
                for (int i = 0; i < 6; i++) own[i] += weights[k] * weights[k] * stiffness[6 * (k / HELD) + i];
        if (a % LEVELS)
            for (int i = 0, k = 0; i < 3; i++) {
                float half[3];
                Symmetric::times(inverse[a - 1], upright[a] + 3 * i, half);
                for (int j = 0; j <= i; j++, k++) own[k] -= Vector::dot(half, upright[a] + 3 * j);
            }
        Symmetric::invert(own, inverse[a]);
        for (int i = 0; i < 3; i++) residual[a][i] *= free[a];
    }
    // up columns: this thread's part of the residual's norm, and z; then down: the next direction
    const auto up = [&]() {
        float sum = 0.0f;
        EACH_NODE(a, n) {
            float left[3];
            for (int i = 0; i < 3; i++)
                left[i] = residual[a][i] - (a % LEVELS ? Vector::dot(upright[a] + 3 * i, z[a - 1]) : 0.0f);
            Symmetric::times(inverse[a], left, z[a]);
            sum += Vector::dot(left, z[a]);
        }
        return sum;
    };
    const auto down = [&](float share) {
        UNROLL
        for (int a = NODES_EACH - 1; a >= 0; a--) {
            const int n = Block::node(a, thread);
            if (n >= NODES) continue;
            if ((a + 1) % LEVELS) {
                float above[3], eased[3];
                const float *pair = upright[a + 1];
                for (int i = 0; i < 3; i++) above[i] = pair[i] * z[a + 1][0] + pair[3 + i] * z[a + 1][1] + pair[6 + i] * z[a + 1][2];
                Symmetric::times(inverse[a], above, eased);
                for (int i = 0; i < 3; i++) z[a][i] -= eased[i];
            }
            for (int i = 0; i < 3; i++) p[3 * n + i] = z[a][i] + (share != 0.0f ? share * p[3 * n + i] : 0.0f);
        }
    };
    rz[0] = up();
    Block::sum(rz, box[1]);
    down(0.0f);
    __syncthreads();
    for (int iteration = 0; iteration < most && rz[0] > enough; iteration++) {
        bricks_times();
        for (int c = thread; c < springs; c += threads) {
            float moved[3];
            Block::point(p, nodes + HELD * c, weights + HELD * c, moved);
            Symmetric::times(stiffness + 6 * c, moved, pull + 3 * c);
        }
        __syncthreads();
        float ap[NODES_EACH][3], pap[2] = {0.0f, 0.0f}, after[2] = {0.0f, 0.0f};
        EACH_NODE(a, n) {
            const float *own = p + 3 * n;
            for (int i = 0; i < 3; i++) ap[a][i] = inertia[a] * own[i];
            add_bricks(n, ap[a]);
            if (springs > 0) add_pulls(n, ap[a]);
            for (int i = 0; i < 3; i++) ap[a][i] *= free[a];
            pap[0] += Vector::dot(own, ap[a]);
            pap[1] += inertia[a] * Vector::dot(own, own);
        }
        Block::sum(pap, box[0]);
        const float length = rz[0] / fmaxf(fmaxf(pap[0], pap[1]), 1e-30f);
        EACH_NODE(a, n)
            for (int i = 0; i < 3; i++) {
                u[a][i] += length * p[3 * n + i];
                residual[a][i] -= length * ap[a][i];
            }
        after[0] = up();
        Block::sum(after, box[1]);
        down(after[0] / fmaxf(rz[0], 1e-30f));
        rz[0] = after[0];
        __syncthreads();
    }
    EACH_NODE(a, n)
        for (int i = 0; i < 3; i++) p[3 * n + i] = u[a][i];
    __syncthreads();
};

// Adds the rigid motion to u and p by which forces that are left have no sum and no torque, as `balanced` does.
const auto balance = [&](const float left[][3], int springs) {
    float sums[28] = {}, *x = each;
    const float *centre = x + NODES / 2 * 3;
    for (int k = thread; k < 3 * NODES; k += threads) x[k] = in.nodes_position[k];
    __syncthreads();
    const auto add = [&](const float *place, const float *falls) {
        float columns[6][3];
        Block::motions(place, centre, columns);
        UNROLL
        for (int i = 0, k = 0; i < 6; i++) {
            float fall[3];
            Symmetric::times(falls, columns[i], fall);
            UNROLL
            for (int j = 0; j <= i; j++, k++) sums[k] += Vector::dot(fall, columns[j]);
        }
    };
    EACH_NODE(a, n) {
        float columns[6][3];
        const float falls[6] = {inertia[a], 0.0f, inertia[a], 0.0f, 0.0f, inertia[a]};
        add(x + 3 * n, falls);
        Block::motions(x + 3 * n, centre, columns);
        for (int i = 0; i < 6; i++) sums[21 + i] += Vector::dot(columns[i], left[a]);
    }
    for (int c = thread; c < springs; c += threads) {
        float place[3];
        Block::point(x, nodes + HELD * c, weights + HELD * c, place);
        add(place, stiffness + 6 * c);
    }
    UNROLL
    for (int k = 0; k < 28; k += 2) {
        Block::sum(sums + k, box[k / 2 % 2]);
        if (thread == 0) rigid[k] = sums[k], rigid[k + 1] = sums[k + 1];
    }
    if (thread == 0) Block::solve(rigid, rigid + 21);
    __syncthreads();
    EACH_NODE(a, n) {
        float columns[6][3];
        Block::motions(x + 3 * n, centre, columns);
        for (int i = 0; i < 3; i++) {
            for (int k = 0; k < 6; k++) u[a][i] += free[a] * columns[k][i] * rigid[21 + k];
            p[3 * n + i] = u[a][i];
        }
    }
    __syncthreads();
};

// Makes the displacements in p shorter at bricks that would be crushed, as `shortened` does; places come to `each`.
const auto shorten = [&]() {
    float *x = each, *share = each + 3 * NODES, *mark = each + 4 * NODES;
    __syncthreads();
    for (int k = thread; k < 3 * NODES; k += threads) x[k] = in.nodes_position[k];
    for (int n = thread; n < NODES; n += threads) share[n] = 1.0f, mark[n] = 0.0f;
    __syncthreads();
    for (int round = 0;; round++) {
        bool any = false;
        for (int e = thread; e < BRICKS; e += threads) {
            float before[24], after[24], most = 0.0f;
            const int first = in.mesh_bricks[e];
            Block::corners(x + 3 * first, before);
            Block::corners(p + 3 * first, after);
            UNROLL
            for (int node = 0; node < 8; node++) {
                const float own = share[first + Block::corner(node)];
                UNROLL
                for (int i = 3 * node; i < 3 * node + 3; i++) after[i] = before[i] + own * after[i];
                most = fmaxf(most, own);
            }
            const float was = Brick::volume(before);
            if (most > 0 && Brick::volume(after) < fmaxf(LEFT * was, fminf(LEAST, was))) {
                any = true;
                for (int node = 0; node < 8; node++) mark[first + Block::corner(node)] = 1.0f;
            }
        }
        if (!__syncthreads_or(any)) break;
        for (int n = thread; n < NODES; n += threads) {
            if (mark[n] > 0) share[n] *= round < HALVINGS ? 0.5f : 0.0f;
            mark[n] = 0.0f;
        }
        __syncthreads();
    }
    for (int k = thread; k < 3 * NODES; k += threads) p[k] *= share[k / 3];
    __syncthreads();
};
