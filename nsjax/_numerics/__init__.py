"""Tools that know nothing of dynamics: derivatives, roots, series, polynomials, matrices, texts."""
