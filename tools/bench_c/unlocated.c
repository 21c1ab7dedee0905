/* The lanes' vector part alone, for the compiler to vectorise: what it costs without events.
 *
 * A whole block of candidates a step, without a branch. An event is not located but taken at the
 * end of its step, so that the answer is rough; no code for single lanes is run.
 * Build: as lanes.c.
 */
#include "lane_tables.h"

#include <stddef.h>
#include <stdint.h>
#include <string.h>

/* Two of the widest vectors there are. */
enum { BLOCK = 128 / sizeof(real) };

typedef real Row[BLOCK];

typedef struct {
    Row xf, wf, xs, vs, direction, place, velocity, jack_direction, sum;
    Row places[NODES + 1], slopes[NODES + 1];
} State;

typedef struct {
    Row dry, breakaway, friction, spool_offset, pressure_offset, rest[4], quarter[16];
} Coefficients;

/* Numbers in a block. */
int eha_block(void) { return BLOCK; }

/* The first candidate's constants stand for all where no fault changes them. */
static void prepare(real tick, const Plant *candidates, long tests, Coefficients *q)
{
    static _Thread_local Tables m;
    for (int i = 0; i < BLOCK; i++) {
        const Fixed f = fixed_of(candidates + i * tests, tick);
        tabulate(&f, &m);
        q->dry[i] = m.dry;
        q->breakaway[i] = f.t.breakaway;
        q->friction[i] = f.c.FDJ;
        q->spool_offset[i] = f.c.OXS;
        q->pressure_offset[i] = f.c.OPD;
        for (int e = 0; e < 4; e++)
            q->rest[e][i] = m.rest[e];
        for (int e = 0; e < 16; e++)
            q->quarter[e][i] = m.quarter[e];
    }
}

static void spool_block(const Fixed *f, real torque, const Coefficients *q, State *s)
{
    const Plant *c = &f->c;
    for (int i = 0; i < BLOCK; i++) {
        real xf = s->xf[i], wf = s->wf[i], xs = s->xs[i], d = s->direction[i], dry = q->dry[i];
        real still = (torque - c->KSF * xs) * f->by_KF, ring = xf - still;
        real base = (torque - c->KF * dry * d) * f->by_KSF;
        real a = xf * d - dry, w = wf * d, b = (xs - base) * d, v = s->vs[i] * d;
        int moves = d != 0.0;
        s->places[0][i] = xs;
        s->slopes[0][i] = s->vs[i];
#pragma GCC unroll 4
        for (int n = 1; n <= NODES; n++) {
            real na = q->quarter[0][i] * a + q->quarter[1][i] * w + q->quarter[2][i] * b
                      + q->quarter[3][i] * v;
            real nw = q->quarter[4][i] * a + q->quarter[5][i] * w + q->quarter[6][i] * b
                      + q->quarter[7][i] * v;
            real nb = q->quarter[8][i] * a + q->quarter[9][i] * w + q->quarter[10][i] * b
                      + q->quarter[11][i] * v;
            real nv = q->quarter[12][i] * a + q->quarter[13][i] * w + q->quarter[14][i] * b
                      + q->quarter[15][i] * v;
            a = na, w = nw, b = nb, v = nv;
            s->places[n][i] = moves ? base + d * b : xs;
            s->slopes[n][i] = moves ? d * v : 0.0;
        }
        xs = s->places[NODES][i];
        int stops = !moves | (v <= 0.0) | (d * xs >= c->XSM);
        real rest_xf = still + q->rest[0][i] * ring + q->rest[1][i] * wf;
        real rest_wf = q->rest[2][i] * ring + q->rest[3][i] * wf;
        xf = moves ? (a + dry) * d : rest_xf;
        wf = moves ? w * d : rest_wf;
        int clamped = fabs(xf) >= c->XFM;
        xf = clamped ? copysign(c->XFM, xf) : xf;
        real next = fabs(xf) > q->breakaway[i] ? copysign((real)1, xf) : 0.0;
        s->xf[i] = xf;
        s->wf[i] = clamped ? 0.0 : wf;
        s->xs[i] = lesser(greater(xs, -c->XSM), c->XSM);
        s->vs[i] = stops ? 0.0 : v * d;
        s->direction[i] = stops ? next : d;
    }
}

static void jack_block(const Fixed *f, real h, const real (*stages)[5], const Coefficients *q,
                       State *s)
{
    const Plant *c = &f->c;
    int n1 = (int)stages[0][0], n2 = (int)stages[1][0], n3 = (int)stages[2][0];
    real by_tick = f->tick;
    for (int i = 0; i < BLOCK; i++) {
        real x1 = stages[0][1] * s->places[n1][i] + stages[0][2] * s->places[n1 + 1][i]
                  + by_tick * (stages[0][3] * s->slopes[n1][i] + stages[0][4] * s->slopes[n1 + 1][i]);
        real x2 = stages[1][1] * s->places[n2][i] + stages[1][2] * s->places[n2 + 1][i]
                  + by_tick * (stages[1][3] * s->slopes[n2][i] + stages[1][4] * s->slopes[n2 + 1][i]);
        real x3 = stages[2][1] * s->places[n3][i] + stages[2][2] * s->places[n3 + 1][i]
                  + by_tick * (stages[2][3] * s->slopes[n3][i] + stages[2][4] * s->slopes[n3 + 1][i]);
        real w1 = greater(fabs(x1), f->corner), w2 = greater(fabs(x2), f->corner);
        real w3 = greater(fabs(x3), f->corner);
        real d = s->jack_direction[i], v = s->velocity[i], friction = q->friction[i];
        real later = last_velocity(f, h, c->FR + d * friction, v, x1, x2, x3, w1, w2, w3);
        real moved = s->place[i] + 0.5 * h * (v + later);
        int slides = later * d > 0.0, stops = fabs(moved) >= c->XJM;
        real hold = divide(c, w3), push = c->AJ * c->PSR * c->GQ * x3 - c->FR * hold;
        int starts = (d == 0.0) & (fabs(push) > 2.0 * friction * hold);
        s->place[i] = lesser(greater(slides ? moved : s->place[i], -c->XJM), c->XJM);
        s->velocity[i] = slides && !stops ? later : 0.0;
        s->jack_direction[i] = slides && !stops ? d : starts ? copysign((real)1, push) : 0.0;
    }
}

static void spool_residuals(real measured, real weight, real cap, const Coefficients *q, State *s)
{
    for (int i = 0; i < BLOCK; i++) {
        real residual = (measured - q->spool_offset[i] - s->xs[i]) * weight;
        s->sum[i] += lesser(residual * residual, cap);
    }
}

static void pressure_residuals(const Fixed *f, real measured, real weight, real cap,
                          const Coefficients *q, State *s)
{
    const Plant *c = &f->c;
    for (int i = 0; i < BLOCK; i++) {
        real x = s->places[NODES][i];
        real p12 = c->PSR * (c->GQ * x - c->AJ * s->velocity[i])
                   / divide(c, greater(fabs(x), f->corner));
        real left = measured - q->pressure_offset[i] - lesser(greater(p12, -c->PSR), c->PSR);
        s->sum[i] += lesser(left * weight * (left * weight), cap);
    }
}

/* Summed squared weighted residual of each of a block of candidates, each square at most `cap`.
 *
 * Arguments as of eha_lane_costs, without origin, current_before and anchor: a recording begins at
 * zero, and the spool is not re-anchored. One block of candidates, no residuals. Samples with a
 * weight have to be finite.
 */
void eha_unlocated_costs(const int64_t *test, const real *ticks, const int64_t *start,
                         const real *current, const real *spool, const real *pressure,
                         const real *weight, const int64_t *levels,
                         const real (*stages)[16][4][5], long spans, real cap, long tests,
                         const Plant *candidates, double *costs)
{
    int64_t all = start[spans];
    State s;
    Coefficients q;
    memset(&s, 0, sizeof s);
    for (long index = 0; index < spans; index++) {
        const Fixed f = fixed_of(candidates + test[index], ticks[index]);
        prepare(ticks[index], candidates + test[index], tests, &q);
        memset(&s, 0, offsetof(State, sum));
        for (int64_t k = start[index]; k < start[index + 1]; k++) {
            int level = (int)levels[k];
            spool_block(&f, f.c.GM * current[k], &q, &s);
            if (weight[k] != 0.0)
                spool_residuals(spool[k], weight[k], cap, &q, &s);
            for (int step = 0; step < 1 << level; step++)
                jack_block(&f, f.tick / (1 << level), stages[level][step], &q, &s);
            if (weight[all + k] != 0.0)
                pressure_residuals(&f, pressure[k], weight[all + k], cap, &q, &s);
        }
    }
    for (int i = 0; i < BLOCK; i++)
        costs[i] = s.sum[i];
}
