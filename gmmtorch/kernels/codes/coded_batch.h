// What the coder of components works on. The twin is mapping/codec/context_model.py.
#pragma once

#include "../device.h"

namespace gmm {

// The K components, S origins and E viewpoints of a batch, as in `Quantized`. cells: side 2^side m. coarse: 0
// or 1.
struct Batch {
    int64_t k;
    int64_t n_origins;
    int64_t n_seen;
    int64_t side;
    int64_t coarse;
    int64_t* axis_order;
    int64_t* deviation;
    int64_t* shear;
    int64_t* mean;
    int64_t* count;
    int64_t* max_range;
    int64_t* ids;
    int64_t* origins;
    int64_t* n_viewpoints;
    int64_t* seen_from;
    int64_t* share;
};

// Scratch: leaf (S,): the origins in the order of the tree; box (T, 2, D): of its T items; distance, item
// (T,): of the heap; row (S,): zeros; place, normal, cell (K, D).
struct Scratch {
    int64_t* leaf;
    int64_t* box;
    double* distance;
    int64_t* waiting;
    int64_t* row;
    double* place;
    double* normal;
    int64_t* cell;
};

struct Field {
    enum {
        FLAG,
        LEVEL,
        DIGIT,
        LOWER,
        ORDER,
        WIDE,
        RATIO,
        THIN,
        TURN,
        TILT,
        SLOPE,
        ACROSS,
        COUNT,
        VIEWS,
        RANK,
        SHARE,
        ORIGIN,
        ROBOT,
        NUMBER,
        EYE
    };
};

}  // namespace gmm
