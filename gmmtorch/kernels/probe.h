// Shows whether the compiler works.
#pragma once

#include "device.h"

namespace gmm {

GMM_KERNEL probe(int64_t item, int64_t* value) { value[item] = item + 1; }

}  // namespace gmm
