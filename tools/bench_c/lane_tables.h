/* Coefficients of a candidate by the series of ehadiag/model/simd/coefficients.py, on a table of its own.
 *
 * The lanes tabulate 24 steps, eight of each of three lengths, to look at eight instants at once.
 * Here stand all steps up to an eighth of the tick, for scalar code that looks at one instant after
 * the other.
 */
#include "lane_jack.h"

enum { GRID = WHOLE >> 3, HALVINGS = 3, ORDER = 8 };

typedef struct {
    real dry, room, ring_time;
    real quarter[16], rest[4];
    real moving[GRID + 1][16], stuck[GRID + 1][4];
} Tables;

/* Matrices are found in double in any case: a float holds no step of a microsecond. */
static inline void product(const double *a, const double *b, double *out, int n, double scale)
{
    for (int r = 0; r < n; r++)
        for (int q = 0; q < n; q++) {
            double total = a[r * n] * b[q];
            for (int k = 1; k < n; k++)
                total += a[r * n + k] * b[k * n + q];
            out[r * n + q] = total * scale;
        }
}

static inline void copy(const double *from, double *to, int n)
{
    for (int i = 0; i < n * n; i++)
        to[i] = from[i];
}

static inline void keep(const double *from, real *to, int n)
{
    for (int i = 0; i < n; i++)
        to[i] = (real)from[i];
}

/* exp(rates h) for 1 ... GRID finest steps, one behind the other in `out` from n * n on. */
static inline void powers(const double *rates, int n, double tick, double *out)
{
    double scaled[16], term[16] = {0}, power[16] = {0}, spare[16];
    for (int i = 0; i < n * n; i++)
        scaled[i] = rates[i] * (tick / (WHOLE << HALVINGS));
    for (int i = 0; i < n; i++)
        term[i * n + i] = power[i * n + i] = 1.0;
    for (int order = 1; order <= ORDER; order++) {
        product(term, scaled, spare, n, (double)1 / order);
        copy(spare, term, n);
        for (int i = 0; i < n * n; i++)
            power[i] += term[i];
    }
    for (int i = 0; i < HALVINGS; i++) {
        product(power, power, spare, n, 1.0);
        copy(spare, power, n);
    }
    copy(power, out + n * n, n);
    for (int j = 2; j <= GRID; j++)
        product(out + (j - 1) * n * n, out + n * n, out + j * n * n, n, 1.0);
}

static void tabulate_rest(const Fixed *f, Tables *m)
{
    const Plant *c = &f->c;
    double ring[4] = {0.0, 1.0, -(double)c->KF / c->JF, -(double)c->CF / c->JF};
    double stuck[GRID + 1][4] = {{0}}, rest[4], spare[4];
    powers(ring, 2, f->tick, &stuck[0][0]);
    keep(&stuck[0][0], &m->stuck[0][0], (GRID + 1) * 4);
    copy(stuck[GRID], rest, 2);
    for (int i = 0; i < 3; i++) {
        product(rest, rest, spare, 2, 1.0);
        copy(spare, rest, 2);
    }
    keep(rest, m->rest, 4);
}

static void tabulate(const Fixed *f, Tables *m)
{
    const Plant *c = &f->c;
    double force = (double)c->AS * c->GPF, damping = (double)c->GPF / c->GQF * c->AS * c->AS + c->CS;
    m->dry = 0.5 * c->FSS / force;
    m->room = lesser(f->t.breakaway, c->XFM);
    m->ring_time = f->t.ring_rate > 0.0 ? 1.0 / f->t.ring_rate : 1e30;
    double rates[16] = {0.0, 1.0, 0.0, 0.0,
                        -(double)c->KF / c->JF, -(double)c->CF / c->JF, -(double)c->KSF / c->JF, 0.0,
                        0.0, 0.0, 0.0, 1.0,
                        force / c->MS, 0.0, 0.0, -damping / c->MS};
    double moving[GRID + 1][16] = {{0}}, quarter[16];
    powers(rates, 4, f->tick, &moving[0][0]);
    keep(&moving[0][0], &m->moving[0][0], (GRID + 1) * 16);
    product(moving[GRID], moving[GRID], quarter, 4, 1.0);
    keep(quarter, m->quarter, 16);
    tabulate_rest(f, m);
}
