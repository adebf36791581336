// What balls on the nodes of a mesh touch, as part_detection.py finds it: shapes that are near a face of the mesh, then
// pairs of these shapes and the balls of such faces, then their contacts, in order. With one thread also code for a CPU.
struct Vector {
    static __device__ float dot(const float *x, const float *y) { return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]; }
    static __device__ float clip(float x, float most) { return fminf(fmaxf(x, -most), most); }
};

struct Ball {
    float centre[3], radius, moves;
};

struct Hull {
    float centre[3], axes[2][3], half[2], radius, moves;

    __device__ bool reaches(const Ball &ball) const {
        float off[3], far = 0.0f;
        for (int i = 0; i < 3; i++) off[i] = ball.centre[i] - centre[i];
        const float flat[2] = {Vector::dot(axes[0], off), Vector::dot(axes[1], off)};
        for (int k = 0; k < 2; k++) {
            const float beside = flat[k] - Vector::clip(flat[k], half[k]);
            far += beside * beside;
            for (int i = 0; i < 3; i++) off[i] -= flat[k] * axes[k][i];
        }
        return sqrtf(far + Vector::dot(off, off)) - radius - ball.radius < NEAR + fminf(moves + ball.moves, AHEAD);
    }
};

struct Contact {
    float depth, place[3], normal[3], weight;
    bool touches;
};

__shared__ float position[3 * NODES], velocity[3 * NODES], most[threads];
__shared__ Hull hulls[SHAPES];
__shared__ Ball faces[FACES];
__shared__ float balls[4 * BALLS];
__shared__ unsigned char near[SHAPES], hit[SHAPES * FACES], flags[BALLS];
__shared__ int counts[threads], pairs[NEAREST];
__shared__ Contact contacts[NEAREST];

const float dt = in.dt[0];
const auto is_plate = [](int shape) { return shape < FINGERS || (shape >= PLATES && shape < RODS); };
const auto of_plates = [](int shape) { return shape < FINGERS ? shape : shape - PLATES + FINGERS; };
const auto of_capsules = [](int shape) { return shape - (shape < PLATES ? FINGERS : FINGERS + RODS - PLATES); };
const auto inside = [&](int node, int under, int i) {
    return (1 - INSET) * position[3 * node + i] + INSET * position[3 * (node + under) + i];
};

// the hull of each shape, and a ball around each face
for (int k = thread; k < 3 * NODES; k += threads)
    position[k] = in.position[k], velocity[k] = in.velocity[k];
for (int s = thread; s < SHAPES; s += threads) {
    Hull &hull = hulls[s];
    near[s] = 0;
    hull.moves = in.scenery_moves[s];
    if (is_plate(s)) {
        const int k = of_plates(s);
        for (int i = 0; i < 3; i++) {
            hull.centre[i] = in.scenery_plates_centre[3 * k + i];
            for (int axis = 0; axis < 2; axis++) hull.axes[axis][i] = in.scenery_plates_frame[9 * k + 3 * i + axis];
        }
        for (int axis = 0; axis < 2; axis++) hull.half[axis] = in.scenery_plates_half[2 * k + axis];
        hull.radius = in.scenery_plates_radius[k];
    } else {
        const int k = of_capsules(s);
        float way[3];
        for (int i = 0; i < 3; i++) {
            const float start = in.scenery_capsules_start[3 * k + i], end = in.scenery_capsules_end[3 * k + i];
            way[i] = end - start;
            hull.centre[i] = (start + end) / 2;
        }
        const float length = sqrtf(Vector::dot(way, way));
        for (int i = 0; i < 3; i++) hull.axes[0][i] = way[i] / fmaxf(length, 1e-12f), hull.axes[1][i] = 0.0f;
        hull.half[0] = length / 2, hull.half[1] = 0.0f;
        hull.radius = in.scenery_capsules_radius[k];
    }
}
__syncthreads();
most[thread] = 0.0f;
for (int n = thread; n < NODES; n += threads)
    most[thread] = fmaxf(most[thread], Vector::dot(velocity + 3 * n, velocity + 3 * n));
__syncthreads();
float fastest = 0.0f;
for (int k = 0; k < threads; k++) fastest = fmaxf(fastest, most[k]);
fastest = sqrtf(fastest);
for (int f = thread; f < FACES; f += threads) {
    float corners[4][3], far = 0.0f;
    for (int i = 0; i < 3; i++) {
        float sum = 0.0f;
        for (int k = 0; k < 4; k++) sum += corners[k][i] = inside(in.constants_corners[4 * f + k], in.constants_under[f], i);
        faces[f].centre[i] = sum / 4;
    }
    for (int k = 0; k < 4; k++) {
        float off[3];
        for (int i = 0; i < 3; i++) off[i] = corners[k][i] - faces[f].centre[i];
        far = fmaxf(far, Vector::dot(off, off));
    }
    faces[f].radius = sqrtf(far) + RADIUS;
    faces[f].moves = dt * fastest;
}
__syncthreads();

int any = 0;
for (int k = thread; k < SHAPES * FACES; k += threads) {
    hit[k] = hulls[k / FACES].reaches(faces[k % FACES]);
    if (hit[k]) near[k / FACES] = 1, any = 1;
}
any = __syncthreads_or(any);

// the balls, and the pairs of those that are near a shape: each thread has some that follow each other
int total = 0;
if (any) {
    for (int b = thread; b < BALLS; b += threads) {
        float v[3] = {0.0f, 0.0f, 0.0f}, x[3] = {0.0f, 0.0f, 0.0f};
        for (int k = 0; k < 4; k++) {
            const int node = in.constants_nodes[4 * b + k];
            const float weight = in.constants_weights[4 * b + k];
            for (int i = 0; i < 3; i++) {
                v[i] += weight * velocity[3 * node + i];
                x[i] += weight * inside(node, in.constants_inward[b], i);
            }
        }
        for (int i = 0; i < 3; i++) balls[4 * b + i] = x[i];
        balls[4 * b + 3] = sqrtf(Vector::dot(v, v));
    }
    __syncthreads();
    enum { EACH = (BALLS + threads - 1) / threads };
    for (int s = 0; s < SHAPES; s++) {
        if (!near[s]) continue;
        int count = 0, before = total;
        for (int b = thread * EACH; b < BALLS && b < (thread + 1) * EACH; b++) {
            flags[b] = 0;
            if (hit[s * FACES + in.constants_face[b]]) {
                const float *own = balls + 4 * b;
                flags[b] = hulls[s].reaches({{own[0], own[1], own[2]}, RADIUS, dt * own[3]});
            }
            count += flags[b];
        }
        counts[thread] = count;
        __syncthreads();
        for (int k = 0; k < threads; k++) {
            if (k < thread) before += counts[k];
            total += counts[k];
        }
        for (int b = thread * EACH; b < BALLS && b < (thread + 1) * EACH; b++)
            if (flags[b]) {
                if (before < NEAREST) pairs[before] = s * BALLS + b;
                before++;
            }
        __syncthreads();
    }
}

// the contact of each pair
const int listed = total < NEAREST ? total : NEAREST;
for (int k = thread; k < listed; k += threads) {
    const int shape = pairs[k] / BALLS;
    const float *own = balls + 4 * (pairs[k] % BALLS);
    Contact &found = contacts[k];
    float off[3];
    found.weight = 1.0f;
    if (is_plate(shape)) {
        const int n = of_plates(shape);
        float local[3] = {0.0f, 0.0f, 0.0f}, edge[3];
        for (int axis = 0; axis < 3; axis++) {
            for (int i = 0; i < 3; i++)
                local[axis] += (own[i] - hulls[shape].centre[i]) * in.scenery_plates_frame[9 * n + 3 * i + axis];
            edge[axis] = axis < 2 ? local[axis] - Vector::clip(local[axis], hulls[shape].half[axis]) : local[axis];
        }
        if (edge[0] != 0.0f || edge[1] != 0.0f) found.weight = RIM;
        for (int i = 0; i < 3; i++) {
            off[i] = 0.0f;
            for (int axis = 0; axis < 3; axis++) off[i] += in.scenery_plates_frame[9 * n + 3 * i + axis] * edge[axis];
        }
    } else {
        const int n = of_capsules(shape);
        float way[3], from[3];
        for (int i = 0; i < 3; i++) {
            const float start = in.scenery_capsules_start[3 * n + i];
            way[i] = in.scenery_capsules_end[3 * n + i] - start;
            from[i] = own[i] - start;
        }
        const float share = Vector::dot(way, from) / fmaxf(Vector::dot(way, way), 1e-12f);
        for (int i = 0; i < 3; i++) off[i] = from[i] - fminf(fmaxf(share, 0.0f), 1.0f) * way[i];
    }
    const float length = sqrtf(fmaxf(Vector::dot(off, off), 1e-18f));
    found.depth = RADIUS + hulls[shape].radius - length;
    for (int i = 0; i < 3; i++) {
        found.normal[i] = off[i] / length;
        found.place[i] = own[i] - (RADIUS - found.depth / 2) * found.normal[i];
    }
    found.touches = found.depth > -(NEAR + fminf(hulls[shape].moves + dt * own[3], AHEAD));
}
__syncthreads();
for (int k = thread; k < listed; k += threads) {
    int row = 0;
    for (int one = 0; one < k; one++) row += contacts[one].touches;
    if (!contacts[k].touches || row >= ROOM) continue;
    const int shape = pairs[k] / BALLS;
    out.rows_part[row] = pairs[k] % BALLS, out.rows_shape[row] = shape;
    out.rows_share[row] = 0.0f, out.rows_bilateral[row] = false;
    out.rows_depth[row] = contacts[k].depth;
    out.rows_stiffness[row] = contacts[k].weight * in.constants_stiffness[shape];
    out.rows_sliding[row] = in.constants_sliding[shape];
    for (int i = 0; i < 3; i++) {
        out.rows_place[3 * row + i] = contacts[k].place[i], out.rows_normal[3 * row + i] = contacts[k].normal[i];
        out.rows_shift[3 * row + i] = out.rows_stretch[3 * row + i] = 0.0f;
    }
}
if (thread == 0) {
    int rows = 0, moving = 0;
    for (int k = 0; k < listed; k++) {
        moving += contacts[k].touches && rows < ROOM && pairs[k] < PLATES * BALLS;
        rows += contacts[k].touches;
    }
    out.moving[0] = moving;
    out.total[0] = rows < ROOM ? rows : ROOM;
    out.left_out[0] = (rows > ROOM ? rows - ROOM : 0) + (total > NEAREST ? total - NEAREST : 0);
}
