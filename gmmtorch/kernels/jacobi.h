// Eigenvalues and eigenvectors of small symmetric matrices.
#pragma once

#include "device.h"

namespace gmm {

// Turns a symmetric matrix c into its eigenvalues, on the diagonal, by Jacobi's rotations; the columns of v
// become its eigenvectors.
template <int DIM>
GMM_INLINE void diagonalize(double (&c)[DIM][DIM], double (&v)[DIM][DIM]) {
    for (int a = 0; a < DIM; ++a)
        for (int b = 0; b < DIM; ++b) v[a][b] = a == b ? 1.0 : 0.0;
    for (int sweep = 0; sweep < 30; ++sweep) {
        double off = 0.0, on = 0.0;
        for (int a = 0; a < DIM; ++a)
            for (int b = 0; b < DIM; ++b) (a == b ? on : off) += c[a][b] * c[a][b];
        if (!(off > 1e-32 * on)) break;
        for (int a = 0; a < DIM; ++a)
            for (int b = a + 1; b < DIM; ++b) {
                if (c[a][b] == 0.0) continue;
                const double w = (c[b][b] - c[a][a]) / (2.0 * c[a][b]);
                const double t = (w < 0.0 ? -1.0 : 1.0) / (fabs(w) + sqrt(w * w + 1.0));
                const double cosine = 1.0 / sqrt(t * t + 1.0), sine = t * cosine;
                for (int k = 0; k < DIM; ++k) {
                    const double x = c[k][a], y = c[k][b];
                    c[k][a] = cosine * x - sine * y, c[k][b] = sine * x + cosine * y;
                }
                for (int k = 0; k < DIM; ++k) {
                    const double x = c[a][k], y = c[b][k];
                    c[a][k] = cosine * x - sine * y, c[b][k] = sine * x + cosine * y;
                }
                for (int k = 0; k < DIM; ++k) {
                    const double x = v[k][a], y = v[k][b];
                    v[k][a] = cosine * x - sine * y, v[k][b] = sine * x + cosine * y;
                }
            }
    }
}

}  // namespace gmm
