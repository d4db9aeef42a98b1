// Bonxai's probabilistic map behind C functions, for growth.py.
#include "bonxai_map/probabilistic_map.hpp"

#include <cstdint>

using Bonxai::ProbabilisticMap;

extern "C" {

void* bonxai_new(double resolution) { return new ProbabilisticMap(resolution); }

// A scan: ends of beams (n, 3), and of beams without return (m, 3).
void bonxai_insert(void* map, const double* points, int64_t n, const double* no_return, int64_t m,
                   const double* origin) {
    auto& made = *static_cast<ProbabilisticMap*>(map);
    for (int64_t i = 0; i < n; ++i) made.addHitPoint({points[3 * i], points[3 * i + 1], points[3 * i + 2]});
    for (int64_t i = 0; i < m; ++i)
        made.addMissPoint({no_return[3 * i], no_return[3 * i + 1], no_return[3 * i + 2]});
    const std::vector<Eigen::Vector3d> none;  // only updates the cells before the ends
    made.insertPointCloud(none, Eigen::Vector3d(origin[0], origin[1], origin[2]), 1e9);
}

void bonxai_ask(void* map, const double* points, int64_t n, double* occupancy) {
    const auto& grid = static_cast<ProbabilisticMap*>(map)->grid();
    auto accessor = grid.createConstAccessor();
    for (int64_t i = 0; i < n; ++i) {
        const auto* cell = accessor.value(grid.posToCoord(points[3 * i], points[3 * i + 1], points[3 * i + 2]));
        occupancy[i] = cell ? ProbabilisticMap::prob(cell->probability_log) : 0.5;
    }
}
}
