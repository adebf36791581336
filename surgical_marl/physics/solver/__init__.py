"""The accelerations at which all forces balance: Newton, line search, Schur complement, Woodbury, Cholesky."""
