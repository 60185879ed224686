"""Steps in one mode: Runge-Kutta methods, Taylor series, the matrix exponential."""
