/* Constants of the plant, what the spool's law needs of them (ehadiag/model/laws.py), and what ends a
 * step of flapper and spool (ehadiag/model/spool_events.py); for all the models here. */
#include <tgmath.h>

/* Type of the numbers: with -DREAL=float constants have to be of single precision too. */
#ifndef REAL
#define REAL double
#endif
typedef REAL real;

enum { FINEST = 10, WHOLE = 1 << FINEST };
enum { UNSURE = -1, NOTHING, REVERSAL, SPOOL_STOP, BREAKAWAY, FLAPPER_STOP, RELEASE };

/* What a unit needs that has no nuisance but offsets: PLANT of ehadiag_tools.bench.c_model. */
typedef struct {
    real GM, JF, CF, KF, KSF, XFM, GQF, GPF, AS, MS, CS, XSM, FSS, FSS1, PSR, GP, GQ, CLK;
    real AJ, MJ, CJ, XJM, FDJ, FDJ1, FR, OXS, OPD;
} Plant;

typedef struct {
    real force, damping, dynamic, breakaway, ring_damping, ring_rate;
} Scalars;

typedef struct {
    real xf, wf, xs, vs;
    int direction, clamped;
} Spool;

static Scalars spool_law(const Plant *c)
{
    double force = (double)c->AS * c->GPF, damping = (double)c->GPF / c->GQF * c->AS * c->AS + c->CS;
    double ring = 0.5 * (double)c->CF / c->JF, square = (double)c->KF / c->JF - ring * ring;
    return (Scalars){force, damping, 0.5 * (double)c->FSS, c->FSS / force,
                     ring, square > 0.0 ? sqrt(square) : 0.0};
}

static int held(const Plant *c, const Scalars *t, real xf, real xs)
{
    return fabs(xf) <= t->breakaway || (fabs(xs) >= c->XSM && xs * xf > 0.0);
}

static int clamped_event(const Plant *c, const Scalars *t, real torque, const Spool *s)
{
    if ((torque - c->KSF * s->xs - c->KF * s->xf) * s->xf < 0.0)
        return RELEASE;
    if (s->direction == 0)
        return held(c, t, s->xf, s->xs) ? NOTHING : BREAKAWAY;
    if (s->vs * s->direction <= 0.0)
        return REVERSAL;
    return fabs(s->xs) >= c->XSM && s->xs * s->direction > 0.0 ? SPOOL_STOP : NOTHING;
}

static int moving_event(const Plant *c, const Scalars *t, real h, const Spool *a, const Spool *b)
{
    if (b->vs * a->direction <= 0.0)
        return REVERSAL;
    if (fabs(b->xs) >= c->XSM && b->xs * a->direction > 0.0)
        return SPOOL_STOP;
    if (fabs(b->xf) >= c->XFM)
        return FLAPPER_STOP;
    if (a->wf * b->wf < 0.0) {
        real swing = 0.25 * h * fmax(fabs(a->wf), fabs(b->wf));
        real lowest = fmin(a->xf * a->direction, b->xf * a->direction);
        if (lowest - t->dynamic / t->force - swing <= 0.0
            || fmax(fabs(a->xf), fabs(b->xf)) + swing >= c->XFM)
            return UNSURE;
    }
    return NOTHING;
}

static int stuck_event(const Plant *c, const Scalars *t, real h, const Spool *a, const Spool *b)
{
    if (!held(c, t, b->xf, a->xs))
        return BREAKAWAY;
    if (fabs(b->xf) >= c->XFM)
        return FLAPPER_STOP;
    if (a->wf * b->wf < 0.0) {
        real swing = 0.25 * h * fmax(fabs(a->wf), fabs(b->wf));
        if (fmax(fabs(a->xf), fabs(b->xf)) + swing > fmin(t->breakaway, c->XFM))
            return UNSURE;
    }
    return NOTHING;
}

static void change(const Plant *c, const Scalars *t, int event, Spool *s)
{
    switch (event) {
    case REVERSAL:
        s->vs = 0.0;
        s->direction = 0;
        if (fabs(s->xf) > t->breakaway)
            s->direction = s->xf > 0.0 ? 1 : -1;
        break;
    case SPOOL_STOP:
        s->xs = copysign(c->XSM, s->xs);
        s->vs = 0.0;
        s->direction = 0;
        break;
    case BREAKAWAY:
        s->direction = s->xf > 0.0 ? 1 : -1;
        break;
    case FLAPPER_STOP:
        s->xf = copysign(c->XFM, s->xf);
        s->wf = 0.0;
        s->clamped = 1;
        break;
    case RELEASE:
        s->clamped = 0;
        break;
    default:
        break;
    }
}
