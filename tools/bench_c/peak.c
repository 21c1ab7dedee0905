/* What one core does at best: independent chains of operations in the widest vectors there are.
 *
 * Build: cc -O3 -march=native -shared -fPIC peak.c -lm
 */
#if defined(__AVX512F__)
enum { BYTES = 64, CHAINS = 24 };
#elif defined(__AVX__)
enum { BYTES = 32, CHAINS = 12 };
#else
enum { BYTES = 16, CHAINS = 12 };
#endif

enum { WIDTH = BYTES / sizeof(double) };

typedef double Vector __attribute__((vector_size(BYTES)));

/* Numbers in a vector. */
int eha_width(void) { return WIDTH; }

static void begin(Vector *chain, const double *from)
{
    for (int k = 0; k < CHAINS; k++)
        for (int i = 0; i < WIDTH; i++)
            chain[k][i] = from[0] + 0.1 + 1e-3 * (i + k);
}

/* What nobody reads is not computed. */
static void end(const Vector *chain, double *out)
{
    for (int k = 0; k < CHAINS; k++)
        for (int i = 0; i < WIDTH; i++)
            out[0] += chain[k][i];
}

/* Products and sums, so often; returns how many, a pair that fuses being two. */
double eha_products(long rounds, double *out)
{
    Vector chain[CHAINS], scale, shift;
    begin(chain, out);
    scale = 0.5 * chain[0];
    shift = 0.5 * chain[1];
    for (long round = 0; round < rounds; round++)
#pragma GCC unroll 24
        for (int k = 0; k < CHAINS; k++)
            chain[k] = chain[k] * scale + shift;
    end(chain, out);
    return 2.0 * WIDTH * CHAINS * (double)rounds;
}

/* Divisions, so often; returns how many. */
double eha_divisions(long rounds, double *out)
{
    Vector chain[CHAINS], above;
    begin(chain, out);
    above = 2.0 * chain[0];
    for (long round = 0; round < rounds; round++)
#pragma GCC unroll 24
        for (int k = 0; k < CHAINS; k++)
            chain[k] = above / chain[k];
    end(chain, out);
    return WIDTH * CHAINS * (double)rounds;
}
