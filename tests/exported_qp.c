/* The QP of an exported controller, for test_export.py: compiled beside its controller.c. */
#include "controller.c"

int drawn(const double *P, const double *q, const double *A, const double *bound, int contacts,
          double *x, double *residual) {
    static struct controller_qp qp;
    int changes, status;
    qp.contacts = contacts;
    qp.limit = CONTROLLER_MAX_CHANGES;
    qp.n = contacts * INPUTS;
    FOR(i, qp.n) memcpy(qp.P[i], P + i * qp.n, sizeof(double) * (size_t)qp.n);
    memcpy(qp.q, q, sizeof(double) * (size_t)qp.n);
    memcpy(qp.A, A, sizeof(double) * (size_t)(contacts * SIDES * INPUTS));
    memcpy(qp.bound, bound, sizeof(double) * (size_t)(contacts * SIDES));
    status = solve(&qp, residual, &changes);
    memcpy(x, qp.x, sizeof(double) * (size_t)qp.n);
    return changes <= qp.limit ? status : -1;
}
