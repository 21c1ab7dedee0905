/* The population's kernel (ehadiag/model/simd/residuals.py) in C, one candidate at a time.
 *
 * The same steps as the lanes: the spool by quarters of a tick, or with events on tables of
 * transitions; the jack by Radau's collocation, its number of steps in a tick handed over. Events
 * fall on the same finest steps but are found otherwise: the lanes look at eight instants at once
 * on tables of 24 transitions, here regula falsi looks at one after the other on a finer table,
 * which suits scalar code better. As scalar code may, it leaves out what a candidate does not need:
 * a spool at rest is not moved.
 * Build: cc -O3 -march=native -shared -fPIC lanes.c -lm; for single precision with
 * -DREAL=float -fsingle-precision-constant.
 */
#include "lane_tables.h"

#include <stddef.h>
#include <stdint.h>

enum { MOST_PIECES = 32 };

/* What rounding makes of a spool at rest is some 1e4 times more in single precision. */
static const real LEAST_DEPTH = sizeof(real) == sizeof(double) ? -1e-14 : -1e-11, CREEP = 1e-18;

/* A tick of the spool with events; returns whether the jack has taken it too. */
static int event_tick(const Fixed *f, const Tables *m, real torque, Spool *s, Path path, Jack *jack)
{
    const Plant *c = &f->c;
    const Scalars *t = &f->t;
    real pieces[MOST_PIECES][4], unit = f->tick / WHOLE;
    real from_xs = s->xs, from_vs = s->vs;
    int done = 0, single = 0, since = 0, kinks = 0, count = 0;
    while (done < WHOLE) {
        int grid = GRID - (done & (GRID - 1)), step = single ? 1 : grid, settled = single, event;
        int low = 0, high = grid + 1;
        real at_low = s->direction != 0 ? s->vs * s->direction : t->breakaway - fabs(s->xf);
        real at_high = 1.0;
        Spool n;
        single = 0;
        for (;;) {
            real h = step * unit, decides = 1.0;
            n = *s;
            if (s->clamped) {
                if (s->direction != 0) {
                    real steady = (t->force * s->xf - t->dynamic * s->direction) / t->damping;
                    real fade = exp(-h * t->damping / c->MS);
                    n.xs += steady * h + (s->vs - steady) * (1.0 - fade) * c->MS / t->damping;
                    n.vs = steady + (s->vs - steady) * fade;
                }
                event = clamped_event(c, t, torque, &n);
            } else if (s->direction != 0) {
                real rest_xf = m->dry * s->direction;
                real rest_xs = (torque - c->KF * rest_xf) * f->by_KSF;
                real a = s->xf - rest_xf, b = s->xs - rest_xs;
                const real *p = m->moving[step];
                n.xf = rest_xf + p[0] * a + p[1] * s->wf + p[2] * b + p[3] * s->vs;
                n.wf = p[4] * a + p[5] * s->wf + p[6] * b + p[7] * s->vs;
                n.xs = rest_xs + p[8] * a + p[9] * s->wf + p[10] * b + p[11] * s->vs;
                n.vs = p[12] * a + p[13] * s->wf + p[14] * b + p[15] * s->vs;
                event = moving_event(c, t, h, s, &n);
                decides = n.vs * s->direction;
            } else {
                real rest_xf = (torque - c->KSF * s->xs) * f->by_KF, a = s->xf - rest_xf;
                const real *p = m->stuck[step];
                n.xf = rest_xf + p[0] * a + p[1] * s->wf;
                n.wf = p[2] * a + p[3] * s->wf;
                event = stuck_event(c, t, h, s, &n);
                decides = t->breakaway - fabs(n.xf);
            }
            if (settled)
                break;
            if (event == NOTHING) {
                if (step == grid)
                    break;
                low = step;
                at_low = decides;
                at_high *= 0.5;
            } else {
                high = step;
                at_high = decides;
                at_low *= 0.5;
            }
            if (high - low == 1) {
                settled = 1;
                if (low == 0)
                    break;
                step = low;
                single = 1;
            } else if (at_low > 0.0 && at_high < 0.0) {
                step = low + (int)((high - low) * at_low / (at_low - at_high) + 0.5);
                step = step < low + 1 ? low + 1 : step > high - 1 ? high - 1 : step;
            } else {
                step = (low + high) >> 1;
            }
        }
        done += step;
        since += step;
        real end_vs = n.vs;
        *s = n;
        change(c, t, event, s);
        kinks |= event == SPOOL_STOP || (event > NOTHING && s->direction != 0 && s->vs == 0.0);
        int at_node = (done & (2 * GRID - 1)) == 0;
        if ((event > NOTHING && count < MOST_PIECES - NODES) || at_node) {
            pieces[count][0] = since * unit;
            pieces[count][1] = s->xs;
            pieces[count][2] = from_vs;
            pieces[count][3] = end_vs;
            from_vs = s->vs;
            since = 0;
            count++;
        }
        if (at_node) {
            path[0][done / (2 * GRID)] = s->xs;
            path[1][done / (2 * GRID)] = s->vs;
        }
    }
    for (int n = 0; kinks && n < count; n++) {
        real span = pieces[n][0];
        Piece p = {span, from_xs, pieces[n][1], pieces[n][2] * span, pieces[n][3] * span};
        jack_piece(f, &p, 0.0, 1.0, jack);
        from_xs = p.x1;
    }
    return kinks;
}

/* A tick of the spool without events; returns 0, the state as it was, where one may hide. */
static inline int plain_tick(const Fixed *f, const Tables *m, real torque, Spool *s, Path path)
{
    const Plant *c = &f->c;
    path[0][0] = s->xs;
    path[1][0] = s->vs;
    if (s->clamped)
        return 0;
    if (s->direction == 0) {
        real still = (torque - c->KSF * s->xs) * f->by_KF, room = m->room - fabs(still);
        real a = s->xf - still, b = (s->wf + f->t.ring_damping * a) * m->ring_time, wf = s->wf;
        if (room <= 0.0 || a * a + b * b >= room * room)
            return 0;
        s->xf = still + m->rest[0] * a + m->rest[1] * wf;
        wf = m->rest[2] * a + m->rest[3] * wf;
        s->wf = wf;
        for (int n = 1; n <= NODES; n++) {
            path[0][n] = s->xs;
            path[1][n] = 0.0;
        }
        return 1;
    }
    real d = s->direction, bow = f->tick / 16.0, dry = m->dry;
    real base = (torque - c->KF * dry * d) * f->by_KSF;
    real a = s->xf * d - dry, w = s->wf * d, b = (s->xs - base) * d, v = s->vs * d;
    const real *p = m->quarter;
    for (int n = 1; n <= NODES; n++) {
        real na = p[0] * a + p[1] * w + p[2] * b + p[3] * v;
        real nw = p[4] * a + p[5] * w + p[6] * b + p[7] * v;
        real nb = p[8] * a + p[9] * w + p[10] * b + p[11] * v;
        real nv = p[12] * a + p[13] * w + p[14] * b + p[15] * v;
        real swing = bow * greater(fabs(w), fabs(nw));
        if (nv <= 10.0 * LEAST_DEPTH || (w * nw < 0.0 && lesser(a, na) - swing <= LEAST_DEPTH)
            || fabs(na + dry) + swing >= c->XFM)
            return 0;
        a = na;
        w = nw;
        b = nb;
        v = nv;
        path[0][n] = base + d * b;
        path[1][n] = d * v;
    }
    if (d * path[0][NODES] >= c->XSM)
        return 0;
    path[1][NODES] = d * greater(v, CREEP);
    s->xf = (a + dry) * d;
    s->wf = fabs(w) > CREEP ? w * d : 0.0;
    s->xs = path[0][NODES];
    s->vs = path[1][NODES];
    return 1;
}

/* Summed squared weighted residual of each candidate, each square at most `cap`.
 *
 * Arguments as the fields of ehadiag.model.batch.Batch, but the currents of each span's ticks and
 * the one before them (no hysteresis); the levels of SimdModel and STAGES; candidates: (n, tests); residuals: (n, 2, ticks), or null. All of type real but the costs.
 */
void eha_lane_costs(const int64_t *test, const real *ticks, const int64_t *start,
                    const real *origin, const real *current_before, const real *current,
                    const real *spool, const real *pressure, const real *weight,
                    const real (*anchor)[3], const int64_t *levels,
                    const real (*stages)[16][4][5], long spans, real cap, long n, long tests,
                    const Plant *candidates, double *costs, real *residuals)
{
    Tables m;
    int64_t all = start[spans];
    for (long i = 0; i < n; i++)
        costs[i] = 0.0;
    for (long index = 0; index < spans; index++) {
        real gain = anchor[index][0], small = anchor[index][1], large = anchor[index][2];
        int anchored = isfinite(small) || isfinite(large);
        for (long i = 0; i < n; i++) {
            const Plant *c = candidates + i * tests + test[index];
            const Fixed f = fixed_of(c, ticks[index]);
            tabulate(&f, &m);
            real held_xf = f.t.breakaway, filtered = 0.0;
            double sum = 0.0;
            Spool s = {0};
            Jack jack = {0};
            Path path;
            s.xs = lesser(greater(origin[index], -c->XSM), c->XSM);
            s.xf = (c->GM * current_before[index] - c->KSF * s.xs) / c->KF;
            s.xf = greater(lesser(s.xf, held_xf), -held_xf);
            for (int64_t k = start[index]; k < start[index + 1]; k++) {
                real torque = c->GM * current[k];
                int done = !plain_tick(&f, &m, torque, &s, path)
                           && event_tick(&f, &m, torque, &s, path, &jack);
                real error = spool[k] - c->OXS - path[0][NODES];
                if (weight[k] != 0.0 && isfinite(error)) {
                    real residual = error * weight[k];
                    sum += lesser(residual * residual, cap);
                    if (residuals != NULL)
                        residuals[2 * i * all + k] = residual;
                }
                int level = (int)levels[k];
                for (int step = 0; !done && step < 1 << level; step++)
                    jack_step(&f, level, step, stages[level][step], path, &jack);
                if (weight[all + k] != 0.0 && isfinite(pressure[k])) {
                    real x = path[0][NODES];
                    real p12 = c->PSR * (c->GQ * x - c->AJ * jack.velocity)
                                 / divide(c, greater(fabs(x), f.corner));
                    p12 = greater(lesser(p12, c->PSR), -c->PSR);
                    real residual = (pressure[k] - c->OPD - p12) * weight[all + k];
                    sum += lesser(residual * residual, cap);
                    if (residuals != NULL)
                        residuals[(2 * i + 1) * all + k] = residual;
                }
                if (anchored && isfinite(error)) {
                    real move = 0.0;
                    filtered += gain * (error - filtered);
                    if (fabs(error) > large)
                        move = error;
                    else if (fabs(filtered) > small)
                        move = filtered;
                    if (move != 0.0)
                        filtered = 0.0;
                    s.xs = greater(lesser(s.xs + move, c->XSM), -c->XSM);
                }
            }
            costs[i] += sum;
        }
    }
}
