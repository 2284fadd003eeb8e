// Workload W1 of test_sweep.py by hand: Tsitouras' 5(4) pair in the lanes of SIMD registers. Each
// lane has its own step size, and takes the next run from the queue as soon as its own has ended.
// Build: g++ -O3 -march=native -o sweep_limit sweep_limit.cpp    Run: ./sweep_limit n T tolerance
// Prints the seconds of processor time and the sum of |x1(T)|; without n, the bits of a register.
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <initializer_list>
#ifdef __AVX__
#include <immintrin.h>
#endif

// Lanes of a register. Not more: g++ 12 makes wider vectors four times slower than two registers.
#if defined(__AVX512F__)
constexpr int width = 8;
#elif defined(__AVX__)
constexpr int width = 4;
#else
constexpr int width = 2;
#endif
// A stage waits for the one before it, but not for other registers' stages: with four in turn there
// are 1.5 to 2 times as many steps a second as with one.
constexpr int registers = 4;

typedef double Reals __attribute__((vector_size(8 * width)));
typedef long long Mask __attribute__((vector_size(8 * width)));  // -1 where true, else 0
typedef float Floats __attribute__((vector_size(4 * width)));
typedef int Ints __attribute__((vector_size(4 * width)));

static Reals select(Mask m, Reals a, Reals b) { return m ? a : b; }
static Reals lesser(Reals a, Reals b) { return a < b ? a : b; }
static Reals greater(Reals a, Reals b) { return a > b ? a : b; }
static Reals magnitude(Reals a) { return (Reals)((Mask)a & ~(1LL << 63)); }
static Reals sign(Reals a) { return a < 0 ? Reals{} - 1 : Reals{} + 1; }
static bool any(Mask m) {
#if defined(__AVX512F__)
    return _mm512_test_epi64_mask((__m512i)m, (__m512i)m);
#elif defined(__AVX__)
    return _mm256_movemask_pd((__m256d)m);
#else
    return m[0] | m[1];
#endif
}

constexpr double damping = 0.5, mus = 1.0, p1 = 0.6, p3 = 10.0, first_step = 0.05;

// The accelerations' weights in x2, Comput. Math. Appl. 62 (2011) 770-775: a row a stage, the last
// one the solution, which is the next step's first stage. E: the same of the error estimate.
constexpr int stages = 7, last = stages - 1;
constexpr double A[stages][stages] = {
    {},
    {0.161},
    {-0.008480655492356989, 0.335480655492357},
    {2.8971530571054935, -6.359448489975075, 4.3622954328695815},
    {5.325864828439257, -11.748883564062828, 7.4955393428898365, -0.09249506636175525},
    {5.86145544294642, -12.92096931784711, 8.159367898576159, -0.071584973281401,
     -0.028269050394068383},
    {0.09646076681806523, 0.01, 0.4798896504144996, 1.379008574103742, -3.290069515436081,
     2.324710524099774}};
constexpr double E[stages] = {0.001780011052225777, 0.000816434459656746, -0.007880878010261994,
                              0.1447110071732629,   -0.5823571654525552,  0.45808210592918686,
                              -0.015151515151515152};

// As x1' = x2, the stages' accelerations are all that is kept. Their weights in x1: A A and E A.
struct Squared {
    double c[stages], AA[stages][stages], EA[stages];
};
constexpr Squared squared() {
    Squared s{};
    for (int j = 0; j < stages; j++)
        for (int k = 0; k < j; k++) {
            s.EA[k] += E[j] * A[j][k];
            for (int i = j + 1; i < stages; i++) s.AA[i][k] += A[i][j] * A[j][k];
        }
    for (int i = 0; i < stages; i++)
        for (int j = 0; j < i; j++) s.c[i] += A[i][j];
    return s;
}
constexpr Squared S = squared();

// The runs in the lanes of a register, all of which slip; slip[i] is the sign of r_i.
struct Lanes {
    int run[width];
    Reals nu[2], slip[2], t, x1, x2, a, h;
    Reals middle, reach2, constant;  // of the force, see `acceleration`

    Reals gap(int i, Reals x2) const { return slip[i] * (nu[i] - x2); }

    // The forces slip[i] (mu(r_i) - p1) are -c / (x2 - pole_i), where c = (mus - p1) / p3 and
    // pole_i = nu[i] + slip[i] / p3. With w = x2 - middle, from the middle of the poles, their sum
    // is the one quotient -2 c w / (w^2 - reach^2).
    void set_forces() {
        Reals reach = 0.5 * (nu[0] - nu[1] + (slip[0] - slip[1]) / p3);
        reach2 = reach * reach;
        middle = 0.5 * (nu[0] + nu[1] + (slip[0] + slip[1]) / p3);
        constant = p1 * (slip[0] + slip[1]) - damping * middle;
    }

    // x2', where `rest` is the part of it that does not depend on x2: constant - x1.
    Reals acceleration(Reals rest, Reals w) const {
        return rest - w * (damping + 2 * (mus - p1) / p3 / (w * w - reach2));
    }
    Reals start(Reals x1, Reals x2) const { return acceleration(constant - x1, x2 - middle); }
};

// What a step of duration d leads to.
struct Step {
    Reals d, t, x1, x2, a, h;
    Mask kept;
};

// Steps that passed a boundary end there, or at the end of the stick phase that follows.
static void pass_boundary(Lanes &lanes, Step &step, Mask passed, double T) {
    Reals d = step.d, x1 = lanes.x1;
    Reals way[2];  // to the boundaries that were passed: the nearer one came first
    for (int i : {0, 1})
        way[i] = select(lanes.gap(i, step.x2) < 0, lanes.gap(i, lanes.x2), Reals{} + HUGE_VAL);
    Mask first = way[0] < way[1];  // it is belt 0's
    Reals v = select(first, lanes.nu[0], lanes.nu[1]);
    Reals other = select(first, lanes.nu[1], lanes.nu[0]);
    Reals slip = select(first, lanes.slip[0], lanes.slip[1]);
    Reals slip_other = select(first, lanes.slip[1], lanes.slip[0]);

    // x1 over the step's fraction s in [0, 1] is the quintic that has the right x1, x1' and x1''
    // at both ends; x1' is then a quartic, as good as the pair's own interpolants.
    Reals c1 = d * lanes.x2, c2 = 0.5 * d * d * lanes.a;
    Reals r0 = step.x1 - x1 - c1 - c2, r1 = d * step.x2 - c1 - 2 * c2, r2 = d * d * step.a - 2 * c2;
    Reals c3 = 10 * r0 - 4 * r1 + 0.5 * r2;
    Reals c4 = -15 * r0 + 7 * r1 - r2;
    Reals c5 = 6 * r0 - 3 * r1 + 0.5 * r2;
    // Newton's method from the end of the step, halving the bracket where it leaves it.
    Reals s = Reals{} + 1, low = Reals{}, high = s, moved;
    do {
        Reals value = c1 - d * v + s * (2 * c2 + s * (3 * c3 + s * (4 * c4 + s * 5 * c5)));
        Reals slope = 2 * c2 + s * (6 * c3 + s * (12 * c4 + s * 20 * c5));
        Mask beyond = slip * value > 0;
        low = select(beyond, low, s);
        high = select(beyond, s, high);
        Reals next = s - value / slope;
        next = select(next >= low, next, 0.5 * (low + high));
        next = select(next <= high, next, 0.5 * (low + high));
        moved = magnitude(next - s);
        s = next;
    } while (any(passed & (moved > 1e-5)));  // what is left is its square
    x1 += s * (c1 + s * (c2 + s * (c3 + s * (c4 + s * c5))));

    Reals t = lanes.t + s * d, belt = sign(v), across = sign(other - v);
    Reals needed =
        across * (p1 + (mus - p1) / (1 + p3 * magnitude(other - v))) - x1 - damping * v;
    Mask sticks = magnitude(needed) < mus;  // and slips on when the needed force is mus
    Reals duration = select(sticks, lesser((needed + belt * mus) / v, T - t), Reals{});
    slip = select(sticks, belt, -slip);
    slip_other = select(sticks, across, slip_other);
    lanes.slip[0] = select(passed, select(first, slip, slip_other), lanes.slip[0]);
    lanes.slip[1] = select(passed, select(first, slip_other, slip), lanes.slip[1]);
    lanes.set_forces();
    step.t = select(passed, t + duration, step.t);
    step.x1 = select(passed, x1 + v * duration, step.x1);
    step.x2 = select(passed, v - 1e-12 * slip, step.x2);
    step.a = select(passed, lanes.start(step.x1, step.x2), step.a);
    step.h = select(passed, Reals{} + first_step, step.h);
}

typedef Reals Stages[stages][registers];

// The sum over the first `count` stages, in the lanes of register n.
static Reals weighted(const double (&weights)[stages], const Stages &K, int n, int count) {
    Reals sum = weights[0] * K[0][n];
#pragma GCC unroll 8
    for (int j = 1; j < count; j++) sum += weights[j] * K[j][n];
    return sum;
}

// The next step of all lanes.
static void advance(Lanes (&all)[registers], double T, double tolerance) {
    Step steps[registers];
    Stages K;  // the accelerations
    Reals rest[registers], drift[registers], d2[registers], w[registers];
#pragma GCC unroll 8
    for (int n = 0; n < registers; n++) {
        Lanes &lanes = all[n];
        Reals d = lesser(lanes.h, T - lanes.t);
        steps[n].d = d;
        drift[n] = d * lanes.x2;
        d2[n] = d * d;
        rest[n] = lanes.constant - lanes.x1;
        w[n] = lanes.x2 - lanes.middle;
        K[0][n] = lanes.a;
    }
#pragma GCC unroll 8
    for (int i = 1; i < stages; i++)
#pragma GCC unroll 8
        for (int n = 0; n < registers; n++) {
            Reals sum1 = i > 1 ? weighted(S.AA[i], K, n, i - 1) : Reals{};
            Reals sum2 = weighted(A[i], K, n, i), d = steps[n].d;
            steps[n].x1 = all[n].x1 + S.c[i] * drift[n] + d2[n] * sum1;
            steps[n].x2 = all[n].x2 + d * sum2;
            K[i][n] =
                all[n].acceleration(rest[n] - S.c[i] * drift[n] - d2[n] * sum1, w[n] + d * sum2);
        }
#pragma GCC unroll 8
    for (int n = 0; n < registers; n++) {
        Lanes &lanes = all[n];
        Step &step = steps[n];
        step.t = lanes.t + step.d;
        step.a = K[last][n];
        Reals error1 = d2[n] * weighted(S.EA, K, n, last);
        Reals error2 = step.d * weighted(E, K, n, stages);
        Reals scale1 = 1 + greater(magnitude(lanes.x1), magnitude(step.x1));
        Reals scale2 = 1 + greater(magnitude(lanes.x2), magnitude(step.x2));
        Reals error = greater(magnitude(error1) * scale2, magnitude(error2) * scale1);
        Reals allowed = tolerance * scale1 * scale2;
        step.kept = error <= allowed;  // not where it is NaN, from far beyond a boundary
        // Next: h times 0.9 (error / allowed)^(-1/5), within 1/5 and 5, by the bits of floats: read
        // as integers they are nearly 2^23 (127 + log2), which is good enough for a step size.
        constexpr int octave = 1 << 23, most = 12 * octave, one = 127 * octave;
        Ints ratio = (Ints)__builtin_convertvector(error, Floats) -
                     (Ints)__builtin_convertvector(allowed, Floats);
        ratio = ratio < most ? ratio : Ints{} + most;
        ratio = ratio > -most ? ratio : Ints{} - most;
        Floats bits = (one - 0.15f * octave) - 0.2f * __builtin_convertvector(ratio, Floats);
        Floats factor = (Floats)__builtin_convertvector(bits, Ints);
        step.h = lanes.h * __builtin_convertvector(factor, Reals);
    }
#pragma GCC unroll 8
    for (int n = 0; n < registers; n++) {
        Lanes &lanes = all[n];
        Step &step = steps[n];
        Reals nearest = lesser(lanes.gap(0, step.x2), lanes.gap(1, step.x2));
        Mask passed = select(step.kept, nearest, Reals{}) < 0;
        if (any(passed)) pass_boundary(lanes, step, passed, T);
        lanes.t = select(step.kept, step.t, lanes.t);
        lanes.x1 = select(step.kept, step.x1, lanes.x1);
        lanes.x2 = select(step.kept, step.x2, lanes.x2);
        lanes.a = select(step.kept, step.a, lanes.a);
        lanes.h = step.h;
    }
}

// The sum of |x1(T)| of the n x n runs.
static double sweep(int n, double T, double tolerance) {
    Lanes all[registers] = {};
    for (Lanes &lanes : all) {
        lanes.t += T;
        for (int &run : lanes.run) run = -1;
    }
    double sum = 0;
    for (int next = 0, ended = 0;;) {
        for (Lanes &lanes : all) {
            Mask done = lanes.t >= T;
            if (!any(done)) continue;
            for (int l = 0; l < width; l++) {
                if (!done[l]) continue;
                if (lanes.run[l] >= 0) sum += std::fabs(lanes.x1[l]), ended++;
                lanes.run[l] = next < n * n ? next++ : -1;
                if (lanes.run[l] < 0) continue;
                lanes.nu[0][l] = -0.7 + 1.4 * (lanes.run[l] / n + 0.5) / n;
                lanes.nu[1][l] = -0.6987 + 1.4 * (lanes.run[l] % n + 0.5) / n;
                for (int i : {0, 1}) lanes.slip[i][l] = lanes.nu[i][l] > 0 ? 1 : -1;
                lanes.t[l] = 0, lanes.x1[l] = 1.5, lanes.x2[l] = 0, lanes.h[l] = first_step;
            }
            lanes.set_forces();
            lanes.a = lanes.start(lanes.x1, lanes.x2);
        }
        if (ended == n * n) return sum;
        advance(all, T, tolerance);
    }
}

int main(int argc, char **argv) {
    if (argc < 4) return std::printf("%d\n", 64 * width), 0;
    std::clock_t start = std::clock();
    double sum = sweep(std::atoi(argv[1]), std::atof(argv[2]), std::atof(argv[3]));
    std::printf("%.6f %.10f\n", double(std::clock() - start) / CLOCKS_PER_SEC, sum);
}
