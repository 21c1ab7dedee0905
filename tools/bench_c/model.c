/* The monitoring model in C, to measure the project's kernels against.
 *
 * The same algorithm as ehadiag/model/scalar/spool_tick.py and jacktick.py, run free: spool and
 * flapper by transition matrices with events located by halving, the jack by closed forms.
 * Build: cc -O3 -march=native -shared -fPIC model.c -lm
 */
#include "plant.h"

enum { BASE = 3, NODE_LEVEL = 5, ROOM = 128, COLUMNS = 4 };
enum { LAST = WHOLE - (WHOLE >> BASE), MOST_PARTS = 32, BISECTIONS = 30 };

static const double BEND = 0.05e-6, LAST_BEND = 0.002e-6;
static const double SHORTEST = 1e-9, TRAVEL = 1.0e-6, RATIO = 0.05, PART_BEND = 0.1e-6;
static const double DRIFT = -0.45;

typedef struct {
    double spool, divide, by_divide, ease;
} Valve;

typedef struct {
    double p0, p1, p2, excess, rate;
} Approach;

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

static Valve valve(const Plant *c, double spool)
{
    double divide = c->GQ * fmax(fabs(spool), c->PSR / c->GP) + c->PSR * c->CLK;
    return (Valve){spool, divide, 1.0 / divide, 1.0 / (c->AJ * c->AJ * c->PSR + c->CJ * divide)};
}

static int parts_of(double origin, double target, double rise0, double rise1)
{
    double travel = fabs(target - origin), bend = 0.125 * fabs(rise1 - rise0);
    double nearest = origin * target <= 0.0 ? 0.0 : fmin(fabs(origin), fabs(target));
    double limit = fmax(TRAVEL, RATIO * nearest);
    if (travel < limit && bend < PART_BEND)
        return 1;
    double parts = 1.0 + floor(fmax(travel / limit, sqrt(bend / PART_BEND)));
    return parts < MOST_PARTS ? (int)parts : MOST_PARTS;
}

static double sign_change(const Approach *p, double span)
{
    double low = 0.0, high = span, sign = p->p0 + p->excess > 0.0 ? 1.0 : -1.0;
    for (int i = 0; i < BISECTIONS; i++) {
        double t = 0.5 * (low + high);
        if (sign * (p->p0 + t * (p->p1 + t * p->p2) + p->excess * exp(-p->rate * t)) > 0.0)
            low = t;
        else
            high = t;
    }
    return high;
}

static Approach approach(const Plant *c, double load, double per_span, double velocity,
                         const Valve *from, const Valve *to, double end_rate)
{
    double gain = c->AJ * c->PSR * c->GQ;
    double steady = (gain * from->spool - load * from->divide) * from->ease;
    double end_steady = (gain * to->spool - load * to->divide) * to->ease;
    double turn = fabs(to->spool) > c->PSR / c->GP ? copysign(c->GQ, to->spool) : 0.0;
    double slope = end_rate * (gain - (load + c->CJ * end_steady) * turn) * to->ease;
    double mean = (end_steady - steady) * per_span;
    double tau = c->MJ * from->divide * from->ease, end_tau = c->MJ * to->divide * to->ease;
    double drift = fmax((end_tau - tau) * per_span, DRIFT);
    double once = 1.0 + drift, twice = 1.0 + 2.0 * drift, both = tau + end_tau;
    double inverse = 1.0 / (once * twice * both), share = inverse * both;
    Approach p;
    p.p2 = (slope - mean) * per_span * once * share;
    p.p1 = (2.0 * mean - slope - 2.0 * p.p2 * tau) * twice * share;
    p.p0 = steady - tau * p.p1;
    p.excess = velocity - p.p0;
    p.rate = (c->AJ * c->AJ * c->PSR * (from->by_divide + to->by_divide) + 2.0 * c->CJ)
                 * (1.0 / (6.0 * c->MJ))
             + inverse * once * twice * (4.0 / 3.0);
    return p;
}

/* Run the model from rest over n ticks; fdj is the severity FDJ. */
void eha_respond(const Plant *c, const Scalars *t, const double (*moving)[4][4],
                 const double (*stuck)[2][2], const double *decay, double fdj,
                 const double *current, long n, double tick, double *spool_out,
                 double *pressure_out, double *position_out)
{
    double nodes[ROOM][COLUMNS];
    Spool s = {0};
    double dynamic = c->FDJ0 + fdj * (c->FDJ1 - c->FDJ0), fixed = 2.0 * dynamic;
    double gain = c->AJ * c->PSR * c->GQ;
    double velocity = 0.0, place = 0.0, direction = 0.0;
    Valve now = valve(c, 0.0);
    for (long k = 0; k < n; k++) {
        int count = spool_tick(c, t, moving, stuck, decay, c->GM * current[k], tick, &s, nodes);
        spool_out[k] = s.xs;
        for (int node = 0; node < count; node++) {
            double span = nodes[node][0], start = now.spool, target = nodes[node][1];
            double per_span = 1.0 / span;
            double rise0 = span * nodes[node][2], rise1 = span * nodes[node][3];
            int parts = parts_of(start, target, rise0, rise1);
            for (int part = 1; part <= parts; part++) {
                double left = span, per_left = per_span, end_spool = target, rise = rise1;
                if (parts > 1) {
                    double x = (double)part / parts, y = 1.0 - x;
                    left = span / parts;
                    per_left = per_span * parts;
                    end_spool = start + x * x * (3.0 - 2.0 * x) * (target - start)
                                + x * y * (y * rise0 - x * rise1);
                    rise = 6.0 * x * y * (target - start) + y * (1.0 - 3.0 * x) * rise0
                           + x * (3.0 * x - 2.0) * rise1;
                }
                Valve end = valve(c, end_spool);
                while (left > SHORTEST) {
                    if (direction == 0.0) {
                        double push0 = gain * now.spool * now.by_divide - c->FR;
                        double push1 = gain * end.spool * end.by_divide - c->FR;
                        if (fabs(push1) <= fixed || (fabs(place) >= c->XJM && place * push1 > 0.0))
                            break;
                        direction = push1 > 0.0 ? 1.0 : -1.0;
                        if (push0 * direction <= fixed) {
                            double wait = (fixed * direction - push0) / (push1 - push0);
                            now = valve(c, now.spool + wait * (end_spool - now.spool));
                            left -= wait * left;
                            per_left = 1.0 / fmax(left, SHORTEST);
                        }
                        continue;
                    }
                    Approach p = approach(c, c->FR + direction * dynamic, per_left, velocity, &now,
                                          &end, rise * per_span);
                    double fade = exp(-left * p.rate);
                    double end_velocity = p.p0 + left * (p.p1 + left * p.p2) + p.excess * fade;
                    if (end_velocity * direction > 0.0) {
                        place += left * (p.p0 + left * (0.5 * p.p1 + left * p.p2 * (1.0 / 3.0)));
                        place += p.excess * (1.0 - fade) / p.rate;
                        velocity = end_velocity;
                        if (fabs(place) >= c->XJM && place * velocity > 0.0) {
                            place = copysign(c->XJM, place);
                            velocity = direction = 0.0;
                        }
                        break;
                    }
                    double moved = sign_change(&p, left);
                    now = valve(c, now.spool + moved * per_left * (end_spool - now.spool));
                    left -= moved;
                    per_left = 1.0 / fmax(left, SHORTEST);
                    velocity = direction = 0.0;
                }
                now = end;
            }
        }
        double p12 = c->PSR * (c->GQ * now.spool - c->AJ * velocity) * now.by_divide;
        pressure_out[k] = fmin(fmax(p12, -c->PSR), c->PSR);
        position_out[k] = place;
    }
}
