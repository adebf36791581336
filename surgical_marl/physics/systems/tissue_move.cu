// The step of tissue_step.py's `move`: displacements with additional forces, shortened where a brick would be crushed.
__shared__ float x[3 * NODES];
const int rows = in.total[0], moving = in.moving[0];

hold(rows);
hang(rows);
if (moving > 0) {
    for (int k = thread; k < 3 * ROOM; k += threads) pull[k] = k < 3 * moving ? in.pushed[k] : 0.0f;
    linearise();
    assemble();
    const auto push = [&](int n, float *found) {
        for (int i = 0; i < 3; i++) found[i] = 0.0f;
        add_pulls(n, found);
    };
    EACH_NODE(a, n) {
        for (int i = 0; i < 3; i++) u[a][i] = 0.0f;
        push(n, residual[a]);
    }
    improve(0, PUSHES, LITTLE);
    if (LOOSE) {
        float left[NODES_EACH][3];
        EACH_NODE(a, n) {
            push(n, left[a]);
            for (int i = 0; i < 3; i++) left[a][i] -= inertia[a] * u[a][i];
        }
        balance(left, 0);
    }
}
for (int k = thread; k < 3 * NODES; k += threads) p[k] = in.shift[k] + (moving > 0 ? p[k] : 0.0f);
shorten();
for (int k = thread; k < 3 * NODES; k += threads) {
    x[k] = in.nodes_position[k] + p[k];
    out.position[k] = x[k];
    out.velocity[k] = p[k] / DT;
}
__syncthreads();
for (int c = thread; c < rows; c += threads) {
    float moved[3];
    Block::point(p, nodes + HELD * c, weights + HELD * c, moved);
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
