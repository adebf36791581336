// What the threads of a block have in common: nodes and bricks that they share, and sums over all of them.
// A thread has bricks thread, thread + threads, ...: EACH gives its own ones, and their numbers. It has columns of nodes
// likewise: EACH_NODE gives their nodes, from below.
// With one thread this is also code for a CPU.
#ifdef __CUDA_ARCH__
#define UNROLL _Pragma("unroll")
#else
#define UNROLL
#endif
#define EACH(own, number, count) \
    UNROLL for (int own = 0; own < ((count) + threads - 1) / threads; own++) \
        if (const int number = thread + own * threads; number < (count))
#define EACH_NODE(own, number) \
    UNROLL for (int own = 0; own < NODES_EACH; own++) \
        if (const int number = Block::node(own, thread); number < NODES)
enum {
    BRICKS_EACH = (BRICKS + threads - 1) / threads,
    NODES_EACH = (NODES / LEVELS + threads - 1) / threads * LEVELS
};

struct Block {
    static __device__ int node(int own, int thread) { return (thread + own / LEVELS * threads) * LEVELS + own % LEVELS; }
    // Sums up two numbers of each thread. Calls that follow each other take different boxes of 64 numbers.
    static __device__ void sum(float *pair, float *box) {
#ifdef __CUDA_ARCH__
        for (int i = 0; i < 2; i++) {
            for (int far = 16; far > 0; far /= 2) pair[i] += __shfl_xor_sync(~0u, pair[i], far);
            if (threadIdx.x % 32 == 0) box[32 * i + threadIdx.x / 32] = pair[i];
        }
        __syncthreads();
        for (int i = 0; i < 2; i++) {
            pair[i] = 0.0f;
            for (int warp = 0; warp < threads / 32; warp++) pair[i] += box[32 * i + warp];
        }
#endif
    }
    // The nodes of a brick, by numbers from its first one; places [n, 3] that begin at that one become [8, 3].
    static __device__ int corner(int node) { return (node & 4 ? STRIDE_X : 0) + (node & 2 ? STRIDE_Y : 0) + (node & 1); }
    static __device__ void corners(const float *first, float *found) {
        UNROLL
        for (int node = 0; node < 8; node++) {
            const float *own = first + 3 * corner(node);
            UNROLL
            for (int i = 0; i < 3; i++) found[3 * node + i] = own[i];
        }
    }
    // The motions of a place with a body about a centre: along and about three axes.
    static __device__ void motions(const float *place, const float *centre, float found[][3]) {
        const float x = place[0] - centre[0], y = place[1] - centre[1], z = place[2] - centre[2];
        const float all[6][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}, {0, -z, y}, {z, 0, -x}, {-y, x, 0}};
        UNROLL
        for (int k = 0; k < 6; k++)
            UNROLL
            for (int i = 0; i < 3; i++) found[k][i] = all[k][i];
    }
    // Solves a symmetric, positive definite system of 6 equations in place: its lower half, row by row, and the right side.
    static __device__ void solve(float *matrix, float *right) {
        for (int j = 0; j < 6; j++) {
            float *row = matrix + j * (j + 1) / 2;
            const float least = 1e-7f * row[j];
            for (int k = 0; k <= j; k++) {
                const float *other = matrix + k * (k + 1) / 2;
                for (int i = 0; i < k; i++) row[k] -= row[i] * other[i];
                row[k] = k < j ? row[k] / other[k] : sqrtf(fmaxf(row[k], least));
            }
            for (int i = 0; i < j; i++) right[j] -= row[i] * right[i];
            right[j] /= row[j];
        }
        for (int j = 5; j >= 0; j--) {
            const float *row = matrix + j * (j + 1) / 2;
            right[j] /= row[j];
            for (int i = 0; i < j; i++) right[i] -= row[i] * right[j];
        }
    }
    static __device__ float mean(const float *lower) { return (lower[0] + lower[2] + lower[5]) / 3; }
    // The place of a point on nodes, times its shares.
    static __device__ void point(const float *x, const short *nodes, const float *weights, float *found) {
        for (int i = 0; i < 3; i++) found[i] = 0.0f;
        for (int k = 0; k < HELD; k++)
            for (int i = 0; i < 3; i++) found[i] += weights[k] * x[3 * nodes[k] + i];
    }
};

// Which contacts hang on each node: a chain of numbers HELD * row + k for each, that ends with -1.
struct Hung {
    static __device__ void link(const short *nodes, const float *weights, int rows, int node, short *first, short *next) {
        int last = -1;
        first[node] = -1;
        for (int k = 0; k < HELD * rows; k++)
            if (nodes[k] == node && weights[k] != 0.0f) {
                (last < 0 ? first[node] : next[last]) = (short)k;
                next[last = k] = -1;
            }
    }
};
