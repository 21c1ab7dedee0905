/* Second stage and jack as in ehadiag/model/jack.py, one candidate at a time; what does not change
 * within a recording is in Fixed.
 */
#include "plant.h"

enum { NODES = 4, MOST_CUTS = 32, ITERATIONS = 30 };

static const real COARSE_TRAVEL = 8.0e-6, CORNER_TRAVEL = 4.0e-6;
static const real FINE_TRAVEL = 3.0e-6, FINE_RATIO = 0.3, FRESH_DECAY = 3.0, SHORTEST = 1e-6,
                  BALANCED = 1e-9, SLOWEST = 1e-12;
#define ROOT 2.449489742783178098
static const real C1 = (4.0 - ROOT) / 10.0, C2 = (4.0 + ROOT) / 10.0;
static const real A11 = (88.0 - 7.0 * ROOT) / 360.0, A12 = (296.0 - 169.0 * ROOT) / 1800.0;
static const real A13 = (3.0 * ROOT - 2.0) / 225.0, A21 = (296.0 + 169.0 * ROOT) / 1800.0;
static const real A22 = (88.0 + 7.0 * ROOT) / 360.0, A23 = -(3.0 * ROOT + 2.0) / 225.0;
static const real A31 = (16.0 - ROOT) / 36.0, A32 = (16.0 + ROOT) / 36.0, A33 = 1.0 / 9.0;

typedef struct {
    Plant c;
    Scalars t;
    real tick, by_KSF, by_KF, by_MJ, corner, scale, flow;
} Fixed;

typedef struct {
    real place, velocity, d, fresh;
} Jack;

/* A piece of the spool's path: its length (s), place and rise at both ends (m). */
typedef struct {
    real span, x0, x1, rise0, rise1;
} Piece;

typedef real Path[2][NODES + 1];

static inline real lesser(real a, real b) { return a < b ? a : b; }
static inline real greater(real a, real b) { return a > b ? a : b; }

static inline real divide(const Plant *c, real width)
{
    return c->GQ * width + c->PSR * c->CLK;
}

static inline Fixed fixed_of(const Plant *c, real tick)
{
    return (Fixed){*c, spool_law(c), tick, 1.0 / c->KSF, 1.0 / c->KF, 1.0 / c->MJ, c->PSR / c->GP,
                   1.0 / (c->PSR * c->AJ), c->GQ / c->AJ};
}

static inline real last_velocity(const Fixed *f, real h, real load, real velocity, real x1,
                                   real x2, real x3, real w1, real w2, real w3)
{
    const Plant *c = &f->c;
    real k = h * f->by_MJ;
    real e1 = divide(c, w1) * f->scale, e2 = divide(c, w2) * f->scale;
    real e3 = divide(c, w3) * f->scale;
    real thrust = k * c->AJ, drag = k * c->CJ;
    real y1 = f->flow * x1, y2 = f->flow * x2, y3 = f->flow * x3;
    real f1 = thrust + drag * e1, f2 = thrust + drag * e2, f3 = thrust + drag * e3;
    real z1 = y1 + drag * (A11 * y1 + A12 * y2 + A13 * y3) + k * C1 * load - velocity;
    real z2 = y2 + drag * (A21 * y1 + A22 * y2 + A23 * y3) + k * C2 * load - velocity;
    real z3 = y3 + drag * (A31 * y1 + A32 * y2 + A33 * y3) + k * load - velocity;
    real m11 = e1 + A11 * f1, m12 = A12 * f2, m13 = A13 * f3;
    real m21 = A21 * f1, m22 = e2 + A22 * f2, m23 = A23 * f3;
    real m31 = A31 * f1, m32 = A32 * f2, m33 = e3 + A33 * f3;
    real minor = m11 * m22 - m12 * m21;
    real above = m31 * (m12 * z2 - z1 * m22) - m32 * (m11 * z2 - z1 * m21) + z3 * minor;
    real below = m31 * (m12 * m23 - m13 * m22) - m32 * (m11 * m23 - m13 * m21) + m33 * minor;
    return y3 - e3 * above / below;
}

static inline real piece_place(const Piece *p, real q)
{
    real r = 1.0 - q;
    return p->x0 + q * q * (3.0 - 2.0 * q) * (p->x1 - p->x0)
           + q * r * (r * p->rise0 - q * p->rise1);
}

static real piece_velocity(const Fixed *f, const Piece *p, real load, real velocity,
                             real begin, real end)
{
    real step = end - begin;
    real x1 = piece_place(p, begin + C1 * step), x2 = piece_place(p, begin + C2 * step);
    real x3 = piece_place(p, end);
    return last_velocity(f, step * p->span, load, velocity, x1, x2, x3, greater(fabs(x1), f->corner),
                         greater(fabs(x2), f->corner), greater(fabs(x3), f->corner));
}

static inline real excess(const Fixed *f, const Piece *p, real hold, real q)
{
    real x = piece_place(p, q);
    return f->c.AJ * f->c.PSR * f->c.GQ * x
           - (f->c.FR + hold) * divide(&f->c, greater(fabs(x), f->corner));
}

/* Share of a piece at which the jack stops (Chandrupatla 1997). */
static real stop_share(const Fixed *f, const Piece *p, real load, real velocity, real d, real later,
                       real begin, real end)
{
    real newest = end, other = begin, at_newest = later * d, at_other = velocity * d;
    real share = at_newest / (at_newest - at_other);
    for (int i = 0; i < ITERATIONS; i++) {
        real oldest, at_oldest, q = newest + share * (other - newest);
        real value = piece_velocity(f, p, load, velocity, begin, q) * d;
        if ((value > 0.0) == (at_newest > 0.0)) {
            oldest = newest;
            at_oldest = at_newest;
        } else {
            oldest = other;
            at_oldest = at_other;
            other = newest;
            at_other = at_newest;
        }
        newest = q;
        at_newest = value;
        real least = SHORTEST / fabs(other - newest);
        if (least > 0.5 || fabs(value) < SLOWEST)
            return newest;
        real x = (newest - other) / (oldest - other);
        real y = (at_newest - at_other) / (at_oldest - at_other);
        share = 0.5;
        if (y * y < x && (1.0 - y) * (1.0 - y) < 1.0 - x) {
            share = at_newest / (at_other - at_newest) * at_oldest / (at_other - at_oldest);
            share += (oldest - newest) / (other - newest) * at_newest / (at_oldest - at_newest)
                     * at_other / (at_oldest - at_other);
        }
        share = lesser(greater(share, least), 1.0 - least);
    }
    return newest;
}

/* Jack over the shares begin ... stop of a piece; it may stop and start there. */
static void jack_piece(const Fixed *f, const Piece *p, real begin, real stop, Jack *j)
{
    const Plant *c = &f->c;
    real friction = c->FDJ;
    if (j->d == 0.0) {
        real up = excess(f, p, 2.0 * friction, stop), down = excess(f, p, -2.0 * friction, stop);
        if (up <= 0.0 && 0.0 <= down) {
            j->fresh = 0.0;
            return;
        }
    }
    real near = p->x0 * p->x1 > 0.0 ? lesser(fabs(p->x0), fabs(p->x1)) : 0.0;
    real wanted = (stop - begin) * fabs(p->x1 - p->x0) / greater(FINE_TRAVEL, FINE_RATIO * near);
    if (j->d == 0.0 || j->fresh != 0.0) {
        real scale = divide(c, greater(near, f->corner));
        real decay = (stop - begin) * p->span * (c->AJ * c->AJ * c->PSR / scale + c->CJ) / c->MJ;
        wanted = greater(wanted, decay / FRESH_DECAY);
    }
    int cuts = wanted < MOST_CUTS - 1 ? 1 + (int)wanted : MOST_CUTS, cut = 1;
    real q = begin;
    j->fresh = 0.0;
    while (cut <= cuts) {
        real end = begin + (stop - begin) * cut / cuts;
        if (j->d == 0.0) {
            real hold = 2.0 * friction;
            real up = excess(f, p, hold, end), down = excess(f, p, -hold, end);
            if ((up <= 0.0 && down >= 0.0)
                || (fabs(j->place) >= c->XJM && j->place * (up + down) > 0.0)) {
                q = end;
                cut++;
                continue;
            }
            j->d = up > 0.0 ? 1.0 : -1.0;
            hold *= j->d;
            real low = q, high = end, at_low = excess(f, p, hold, q) * j->d;
            real at_high = j->d > 0.0 ? up : -down;
            for (int i = 0; at_low < 0.0 && i < ITERATIONS; i++) {
                q = low + (high - low) * at_low / (at_low - at_high);
                real value = excess(f, p, hold, q) * j->d;
                if (value < 0.0) {
                    low = q;
                    at_low = value;
                    at_high *= 0.5;
                } else {
                    high = q;
                    at_high = value;
                    at_low *= 0.5;
                }
                real width = greater(fabs(piece_place(p, q)), f->corner);
                if (fabs(value) < BALANCED * fabs(hold) * divide(c, width))
                    break;
                q = high;
                if (high - low < SHORTEST)
                    break;
            }
            j->velocity = 0.0;
            j->fresh = 1.0;
        }
        real load = c->FR + j->d * friction;
        real later = piece_velocity(f, p, load, j->velocity, q, end);
        if (later * j->d > 0.0) {
            j->place += 0.5 * (end - q) * p->span * (j->velocity + later);
            j->velocity = later;
            if (fabs(j->place) >= c->XJM && j->place * j->velocity > 0.0) {
                j->place = copysign(c->XJM, j->place);
                j->velocity = j->d = 0.0;
            }
            q = end;
            cut++;
            continue;
        }
        if (j->velocity != 0.0) {
            real from = q;
            q = stop_share(f, p, load, j->velocity, j->d, later, q, end);
            j->place += 0.5 * (q - from) * p->span * j->velocity;
        } else {
            q = end;
        }
        j->velocity = j->d = 0.0;
        j->fresh = 1.0;
        if (end - q < SHORTEST) {
            q = end;
            cut++;
        }
    }
}

/* A step with a start or a stop, piece by piece of the path. */
static void jack_events(const Fixed *f, int level, int step, const Path path, Jack *j)
{
    int steps = 1 << level;
    real span = f->tick / NODES;
    real begin = (real)step * NODES / steps, stop = (real)(step + 1) * NODES / steps;
    for (int n = (int)begin, last = (int)ceil(stop); n < last; n++) {
        Piece p = {span, path[0][n], path[0][n + 1], span * path[1][n], span * path[1][n + 1]};
        jack_piece(f, &p, greater(begin - n, 0.0), lesser(stop - n, 1.0), j);
    }
}

static inline real stage_place(const Path path, const real *stage, real tick)
{
    int n = (int)stage[0];
    return stage[1] * path[0][n] + stage[2] * path[0][n + 1]
           + tick * (stage[3] * path[1][n] + stage[4] * path[1][n + 1]);
}

/* One of the 2^level steps of a tick; stages: see ehadiag.model.simd.jack.STAGES. */
static inline void jack_step(const Fixed *f, int level, int step, const real (*stages)[5],
                             const Path path, Jack *j)
{
    const Plant *c = &f->c;
    real friction = c->FDJ;
    real x3 = stage_place(path, stages[2], f->tick), w3 = greater(fabs(x3), f->corner);
    if (j->d == 0.0) {
        real hold = divide(c, w3), push = c->AJ * c->PSR * c->GQ * x3 - c->FR * hold;
        int blocked = fabs(j->place) >= c->XJM && j->place * push > 0.0;
        if (fabs(push) > 2.0 * friction * hold && !blocked)
            jack_events(f, level, step, path, j);
        return;
    }
    real x1 = stage_place(path, stages[0], f->tick), w1 = greater(fabs(x1), f->corner);
    real near = x1 * x3 > 0.0 ? lesser(fabs(x1), fabs(x3)) : 0.0, travel = fabs(x3 - x1);
    int coarse = travel > greater(near, COARSE_TRAVEL)
                 || (near < f->corner && greater(w1, w3) > f->corner && travel > CORNER_TRAVEL);
    if (!coarse && j->fresh == 0.0) {
        real x2 = stage_place(path, stages[1], f->tick), w2 = greater(fabs(x2), f->corner);
        real h = f->tick / (1 << level);
        real later = last_velocity(f, h, c->FR + j->d * friction, j->velocity, x1, x2, x3, w1, w2,
                                     w3);
        real moved = j->place + 0.5 * h * (j->velocity + later);
        if (later * j->d > 0.0 && fabs(moved) < c->XJM) {
            j->place = moved;
            j->velocity = later;
            return;
        }
    }
    jack_events(f, level, step, path, j);
}
