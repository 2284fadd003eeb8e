// Workload W1 of test_sweep.py on Boost.odeint: dopri5 with dense output, one run at a time.
// Build: g++ -O3 -march=native -o sweep_peer sweep_peer.cpp    Run: ./sweep_peer n T tolerance
// Prints the seconds of processor time and the sum of |x1(T)|.
#include <array>
#include <boost/numeric/odeint.hpp>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <ctime>

using State = std::array<double, 2>;
constexpr double damping = 0.5, mus = 1.0, p1 = 0.6, p3 = 10.0;

static double mu(double speed) { return (mus - p1) / (1 + p3 * speed) + p1; }
static double sign(double x) { return (x > 0) - (x < 0); }

// x1 at t = T of the run from (1.5, 0) between belts of velocities nu; slip[i] is the sign of r_i.
static double run(std::array<double, 2> nu, double T, double tolerance) {
    State y{1.5, 0.0};
    std::array<double, 2> slip{sign(nu[0]), sign(nu[1])};
    auto stepper = boost::numeric::odeint::make_dense_output(
        tolerance, tolerance, boost::numeric::odeint::runge_kutta_dopri5<State>());
    for (double t = 0;;) {
        auto field = [&](const State& y, State& dy, double) {
            dy = {y[1], -y[0] - damping * y[1]};
            for (int i : {0, 1}) dy[1] += slip[i] * mu(slip[i] * (nu[i] - y[1]));
        };
        auto guard = [&](int i, const State& y) { return slip[i] * (nu[i] - y[1]); };
        stepper.initialize(y, t, 0.05);
        int hit = -1;
        double first = T;
        while (hit < 0 && stepper.current_time() < T) {
            auto [before, after] = stepper.do_step(field);
            for (int i : {0, 1}) {
                if (guard(i, stepper.current_state()) >= 0) continue;
                double low = before, high = after;
                for (State q; high - low > 1e-13;) {
                    double middle = 0.5 * (low + high);
                    if (middle == low || middle == high) break;
                    stepper.calc_state(middle, q);
                    (guard(i, q) < 0 ? high : low) = middle;
                }
                if (high < first) first = high, hit = i;
            }
        }
        stepper.calc_state(first, y);
        if (hit < 0) return y[0];
        t = first;
        int other = 1 - hit;
        double v = nu[hit], beyond = sign(nu[other] - v);
        double needed = -y[0] - damping * v + beyond * mu(std::fabs(nu[other] - v));
        if (std::fabs(needed) < mus) {  // it sticks, and slips on when the needed force is mus
            double duration = (needed + sign(v) * mus) / v;
            if (t + duration >= T) return y[0] + v * (T - t);
            t += duration;
            y[0] += v * duration;
            slip[hit] = sign(v);
            slip[other] = beyond;
        } else {
            slip[hit] = -slip[hit];
        }
        y[1] = v - 1e-12 * slip[hit];
    }
}

int main(int, char** argv) {
    int n = std::atoi(argv[1]);
    double T = std::atof(argv[2]), tolerance = std::atof(argv[3]), sum = 0;
    std::clock_t start = std::clock();
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) {
            double nu0 = -0.7 + 1.4 * (i + 0.5) / n, nu1 = -0.6987 + 1.4 * (j + 0.5) / n;
            sum += std::fabs(run({nu0, nu1}, T, tolerance));
        }
    std::printf("%.6f %.10f\n", double(std::clock() - start) / CLOCKS_PER_SEC, sum);
}
