"""The functions of the C header: the same for every controller of a kind."""

from lmdsl.model.grid.axis import EDGE, MOST_TURNS

LOOK_UP = {
    "bits": """/* The code of a cell. */
static uint32_t lmdsl_look_up(uint32_t cell)
{
    const uint64_t at = (uint64_t)cell * LMDSL_BITS;
    const uint32_t *word = lmdsl_code + at / 32;
    const uint64_t both = word[0] | (uint64_t)word[1] << 32;
    return (uint32_t)(both >> at % 32 & (((uint64_t)1 << LMDSL_BITS) - 1));
}

""",
    "runs": """/* The code of a cell: of the last run that begins at it or before. */
static uint32_t lmdsl_look_up(uint32_t cell)
{
    uint32_t first = 0, beyond = sizeof lmdsl_run / sizeof lmdsl_run[0];
    while (beyond - first > 1) {
        const uint32_t middle = first + (beyond - first) / 2;
        if (lmdsl_run[middle] <= cell)
            first = middle;
        else
            beyond = middle;
    }
    return lmdsl_code[first];
}

""",
}

LOCATE = f"""/* Turn x into a state, wrapped or clipped, and return its cell; -1 outside, or where
 * not finite. What is within {EDGE!r} cells of an edge counts as on it. */
static int64_t lmdsl_locate(const double *x, double *state)
{{
    double cell = 0.0;
    int j;
    for (j = 0; j < LMDSL_STATES; j++) {{
        const lmdsl_axis_t *axis = &lmdsl_axis[j];
        double at = x[j], k;
        if (!isfinite(at))
            return -1;
        if (axis->periodic) {{
            const double span = axis->high - axis->low, away = at - axis->low;
            const double turns = floor(away / span);
            if (!(fabs(turns) <= {MOST_TURNS.hex()}))
                return -1;
            if (!(at >= axis->low && at <= axis->high)) {{
                double rest = away - turns * span;
                rest = rest > 0.0 ? rest : 0.0;
                rest = rest < span ? rest : span;
                at = axis->low + rest;
                at = at < axis->high ? at : axis->high;
            }}
            k = floor((at - axis->low) / axis->width + {EDGE.hex()});
            k = k < axis->cells ? k : 0.0;
        }} else {{
            double t;
            if (LMDSL_CLIP) {{
                at = at < axis->low ? axis->low : at;
                at = at > axis->high ? axis->high : at;
            }}
            t = (at - axis->low) / axis->width;
            k = floor(t + {EDGE.hex()});
            if (k >= axis->cells && (t - axis->cells <= {EDGE.hex()} || at <= axis->high))
                k = axis->cells - 1.0;
            if (!(k >= 0.0 && k < axis->cells))
                return -1;
        }}
        state[j] = at;
        cell += axis->stride * k;
    }}
    return (int64_t)cell;
}}

"""

LOCAL = """/* u = clip(u_k - K_k (x - x_k)), by way of the middle of the cell. */
static void lmdsl_feedback(uint32_t k, uint32_t cell, const double *state, double *u)
{
    double away[LMDSL_STATES];
    int i, j;
    for (i = 0; i < LMDSL_STATES; i++) {
        const lmdsl_axis_t *axis = &lmdsl_axis[i];
        const double span = axis->high - axis->low;
        const uint32_t index = cell / (uint32_t)axis->stride % (uint32_t)axis->cells;
        const double centre = axis->low + ((double)index + 0.5) * axis->width;
        const double point = lmdsl_orbit[k * LMDSL_STATES + (uint32_t)i];
        double origin = centre - point;
        away[i] = state[i] - centre;
        if (axis->periodic) {
            origin = origin - rint(origin / span) * span;
            away[i] = away[i] - rint(away[i] / span) * span;
        }
        away[i] += origin;
    }
    for (j = 0; j < LMDSL_CONTROLS; j++) {
        const uint32_t row = k * LMDSL_CONTROLS + (uint32_t)j;
        double v = lmdsl_at[row];
        for (i = 0; i < LMDSL_STATES; i++)
            v = v - lmdsl_gain[row * LMDSL_STATES + (uint32_t)i] * away[i];
        v = v > lmdsl_least[j] ? v : lmdsl_least[j];
        u[j] = v < lmdsl_most[j] ? v : lmdsl_most[j];
    }
}

"""

_BEGIN = """/* Give the control at a state. Returns its index; LMDSL_LOCAL where the local feedback
 * acts; -1, with u NaN, where there is none. */
static int lmdsl_control(const double *x, double *u)
{
    double state[LMDSL_STATES];
    const int64_t cell = lmdsl_locate(x, state);
    const uint32_t code = cell < 0 ? 0 : lmdsl_look_up((uint32_t)cell);
    int j;
"""

_END = """    for (j = 0; j < LMDSL_CONTROLS; j++)
        u[j] = code ? lmdsl_vector[(code - 1) * LMDSL_CONTROLS + (uint32_t)j] : NAN;
    return (int)code - 1;
}
"""

CONTROL = _BEGIN + _END
CONTROL_LOCAL = (
    _BEGIN
    + """    if (code > LMDSL_VECTORS) {
        lmdsl_feedback(code - 1 - LMDSL_VECTORS, (uint32_t)cell, state, u);
        return LMDSL_LOCAL;
    }
"""
    + _END
)
