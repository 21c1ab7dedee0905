/* The monitoring model in C, to measure the project's kernels against.
 *
 * The same algorithm as ehadiag/model/scalar/spool_tick.py and ehadiag/model/jack.py, run free: spool
 * and flapper by transition matrices with events located by halving, the jack by collocation.
 * Build: cc -O3 -march=native -shared -fPIC model.c -lm
 */
#include "lane_jack.h"

enum { BASE = 3, NODE_LEVEL = 5, ROOM = 128, COLUMNS = 4 };
enum { LAST = WHOLE - (WHOLE >> BASE) };

static const double BEND = 0.05e-6, LAST_BEND = 0.002e-6;

static int rests(const Plant *c, const Scalars *t, double torque, const Spool *s)
{
    if (t->ring_rate <= 0.0)
        return 0;
    double rest = (torque - c->KSF * s->xs) / c->KF;
    double a = s->xf - rest;
    double b = (s->wf + t->ring_damping * a) / t->ring_rate;
    return fabs(rest) + sqrt(a * a + b * b) < fmin(t->breakaway, c->XFM);
}

/* One tick of the spool; returns the number of nodes (span, place, rise at both ends). */
static int spool_tick(const Plant *c, const Scalars *t, const double (*moving)[4][4],
                      const double (*stuck)[2][2], const double *decay, double torque, double tick,
                      Spool *s, double (*nodes)[COLUMNS])
{
    int count = 0, done = 0, since = 0, level = BASE;
    if (s->direction == 0 && !s->clamped && rests(c, t, torque, s))
        level = 0;
    double begin = s->vs, slowest = s->vs, fastest = s->vs;
    while (done < WHOLE) {
        while ((WHOLE >> level) > WHOLE - done)
            level++;
        double h = tick / (1 << level);
        Spool n = *s;
        int event;
        if (s->clamped) {
            if (s->direction != 0) {
                double steady = (t->force * s->xf - t->dynamic * s->direction) / t->damping;
                double fade = decay[level];
                n.xs += steady * h + (s->vs - steady) * (1.0 - fade) * c->MS / t->damping;
                n.vs = steady + (s->vs - steady) * fade;
            }
            event = clamped_event(c, t, torque, &n);
        } else if (s->direction != 0) {
            double rest_xf = t->dynamic * s->direction / t->force;
            double rest_xs = (torque - c->KF * rest_xf) / c->KSF;
            double a = s->xf - rest_xf, b = s->xs - rest_xs;
            const double(*m)[4] = moving[level];
            n.xf = rest_xf + m[0][0] * a + m[0][1] * s->wf + m[0][2] * b + m[0][3] * s->vs;
            n.wf = m[1][0] * a + m[1][1] * s->wf + m[1][2] * b + m[1][3] * s->vs;
            n.xs = rest_xs + m[2][0] * a + m[2][1] * s->wf + m[2][2] * b + m[2][3] * s->vs;
            n.vs = m[3][0] * a + m[3][1] * s->wf + m[3][2] * b + m[3][3] * s->vs;
            event = moving_event(c, t, h, s, &n);
        } else {
            double rest_xf = (torque - c->KSF * s->xs) / c->KF;
            double a = s->xf - rest_xf;
            const double(*m)[2] = stuck[level];
            n.xf = rest_xf + m[0][0] * a + m[0][1] * s->wf;
            n.wf = m[1][0] * a + m[1][1] * s->wf;
            event = stuck_event(c, t, h, s, &n);
        }
        if (level == 0)
            event = NOTHING;
        if (event != NOTHING && level < FINEST) {
            level++;
            continue;
        }
        *s = n;
        double end = s->vs;
        change(c, t, event, s);
        done += WHOLE >> level;
        since += WHOLE >> level;
        slowest = fmin(slowest, end);
        fastest = fmax(fastest, end);
        double span = tick * since / WHOLE;
        double bend = 0.125 * (fastest - slowest) * span;
        int wanted = event > NOTHING
                     || ((done & ((WHOLE >> NODE_LEVEL) - 1)) == 0
                         && (bend > BEND || (done == LAST && bend > LAST_BEND)));
        if (done == WHOLE || (wanted && count < ROOM - 1)) {
            nodes[count][0] = span;
            nodes[count][1] = s->xs;
            nodes[count][2] = begin;
            nodes[count][3] = end;
            count++;
            begin = slowest = fastest = s->vs;
            since = 0;
        }
        if (level > BASE && (done & ((WHOLE >> (level - 1)) - 1)) == 0)
            level--;
    }
    return count;
}

/* Run the model from rest over n ticks. */
void eha_respond(const Plant *c, const double (*moving)[4][4], const double (*stuck)[2][2],
                 const double *decay, const double *current, long n, double tick,
                 double *spool_out, double *pressure_out, double *position_out)
{
    const Fixed f = fixed_of(c, tick);
    const Scalars *t = &f.t;
    double nodes[ROOM][COLUMNS];
    Spool s = {0};
    Jack jack = {0};
    for (long k = 0; k < n; k++) {
        double x = s.xs;
        int count = spool_tick(c, t, moving, stuck, decay, c->GM * current[k], tick, &s, nodes);
        for (int node = 0; node < count; node++) {
            double span = nodes[node][0];
            Piece p = {span, x, nodes[node][1], span * nodes[node][2], span * nodes[node][3]};
            jack_piece(&f, &p, 0.0, 1.0, &jack);
            x = p.x1;
        }
        spool_out[k] = x;
        double p12 = (f.flow * x - jack.velocity) / (f.scale * divide(c, greater(fabs(x), f.corner)));
        pressure_out[k] = greater(lesser(p12, c->PSR), -c->PSR);
        position_out[k] = jack.place;
    }
}
