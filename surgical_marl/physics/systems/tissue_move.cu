// The step of tissue_step.py's `move`: displacements with additional forces, shortened where a brick would be crushed.
__shared__ float x[3 * NODES], u[3 * NODES], push[3 * ROOM], gives[HELD * ROOM], weights[HELD * ROOM];
__shared__ int nodes[HELD * ROOM];
__shared__ short first[NODES], next[HELD * ROOM];
const int rows = in.total[0], moving = in.moving[0];

for (int k = thread; k < 3 * NODES; k += threads) x[k] = in.nodes_position[k], u[k] = in.shift[k];
for (int k = thread; k < HELD * rows; k += threads)
    nodes[k] = in.held_nodes[k], weights[k] = in.held_weights[k], gives[k] = in.gives[k];
for (int k = thread; k < 3 * moving; k += threads) push[k] = in.pushed[k];
__syncthreads();
if (moving > 0)
    for (int n = thread; n < NODES; n += threads) {
        Hung::link(nodes, weights, moving, n, first, next);
        for (int k = first[n]; k >= 0; k = next[k])
            for (int i = 0; i < 3; i++) u[3 * n + i] += gives[k] * push[3 * (k / HELD) + i];
    }
__syncthreads();

float length = 1.0f;
for (bool crushed = true; crushed;) {
    bool any = false;
    for (int e = thread; e < BRICKS; e += threads) {
        float before[24], after[24];
        Block::corners(x + 3 * in.mesh_bricks[e], before);
        Block::corners(u + 3 * in.mesh_bricks[e], after);
        for (int i = 0; i < 24; i++) after[i] = before[i] + length * after[i];
        any |= Brick::volume(after) < LEFT * Brick::volume(before);
    }
    crushed = __syncthreads_or(any);
    if (crushed) length = length > SHORTEST ? length / 2 : 0.0f;
    crushed = crushed && length > 0;
}
for (int k = thread; k < 3 * NODES; k += threads) {
    u[k] *= length;
    x[k] += u[k];
    out.position[k] = x[k];
    out.velocity[k] = u[k] / DT;
}
__syncthreads();
for (int c = thread; c < rows; c += threads) {
    float moved[3];
    Block::point(u, nodes + HELD * c, weights + HELD * c, moved);
    for (int i = 0; i < 3; i++) out.points[3 * c + i] = moved[i];
}
bool torn = false;
if (TEARS > 0)
    for (int e = thread; e < BRICKS; e += threads) {
        float own[24], g[9], left[9], c[3];
        Block::corners(x + 3 * in.mesh_bricks[e], own);
        Brick::to_modes(own);
        Brick::gradient(own, g);
        for (int i = 0; i < 3; i++)
            for (int j = 0; j < 3; j++)
                left[3 * i + j] = (i == j ? TEARS * TEARS : 0.0f) - (g[i] * g[j] + g[3 + i] * g[3 + j] + g[6 + i] * g[6 + j]);
        Vector::cross(left, left + 3, c);
        torn |= left[0] < 0 || left[0] * left[4] - left[1] * left[3] < 0 || Vector::dot(c, left + 6) < 0;
    }
torn = __syncthreads_or(torn);
if (thread == 0) out.torn[0] = torn;
