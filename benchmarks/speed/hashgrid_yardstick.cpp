// The yardstick for the Numba encodings: the same operations in C++ with OpenMP. Only measured against, never shipped.
// Layouts are those of biresnerf/field/cpu/encoding.py: x [n][3], table [entries][2], features [2 levels][n],
// jacobian [levels][6][n]. Built by benchmarks/speed/yardstick.py with g++ -O3 -march=native -ffast-math -fopenmp.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>

namespace {

constexpr uint32_t prime_y = 2654435761u, prime_z = 805459861u;
constexpr int64_t block = 256, chunk = 8192;

struct Level {
  float scale;
  uint32_t stride, mask;
  int64_t first, entries;
};

template <bool hashed> inline uint32_t index_of(uint32_t x, uint32_t y, uint32_t z, uint32_t mask) {
  return hashed ? ((x ^ y ^ z) & mask) : x + y + z;
}

// Corner indices [8][block] and fractions [3][block] of samples begin..begin+count.
template <bool hashed>
inline void corners(const float* x, const Level& level, int64_t begin, int64_t count, uint32_t* corner, float* fraction) {
  const uint32_t step_y = hashed ? prime_y : level.stride, step_z = hashed ? prime_z : level.stride * level.stride;
#pragma omp simd
  for (int64_t j = 0; j < count; j++) {
    const float* p = x + 3 * (begin + j);
    const float px = p[0] * level.scale + 0.5f, py = p[1] * level.scale + 0.5f, pz = p[2] * level.scale + 0.5f;
    const int32_t ix = px, iy = py, iz = pz;
    fraction[j] = px - ix, fraction[block + j] = py - iy, fraction[2 * block + j] = pz - iz;
    const uint32_t ax = ix, bx = ax + 1, ay = iy * step_y, by = ay + step_y, az = iz * step_z, bz = az + step_z;
    corner[j] = index_of<hashed>(ax, ay, az, level.mask);
    corner[block + j] = index_of<hashed>(bx, ay, az, level.mask);
    corner[2 * block + j] = index_of<hashed>(ax, by, az, level.mask);
    corner[3 * block + j] = index_of<hashed>(bx, by, az, level.mask);
    corner[4 * block + j] = index_of<hashed>(ax, ay, bz, level.mask);
    corner[5 * block + j] = index_of<hashed>(bx, ay, bz, level.mask);
    corner[6 * block + j] = index_of<hashed>(ax, by, bz, level.mask);
    corner[7 * block + j] = index_of<hashed>(bx, by, bz, level.mask);
  }
}

template <bool hashed>
void forward(const float* x, const float* table, const Level& level, int64_t begin, int64_t end, int64_t n,
             float* features, float* jacobian) {
  alignas(64) uint32_t corner[8 * block];
  alignas(64) float fraction[3 * block], held[2][8 * block];
  for (int64_t at = begin; at < end; at += block) {
    const int64_t count = std::min(block, end - at);
    corners<hashed>(x, level, at, count, corner, fraction);
    for (int k = 0; k < 8; k++)
      for (int64_t j = 0; j < count; j++) {
        const float* entry = table + 2 * int64_t(corner[k * block + j]);
        held[0][k * block + j] = entry[0], held[1][k * block + j] = entry[1];
      }
    for (int f = 0; f < 2; f++) {
      const float* p = held[f];
      float* out = features + f * n + at;
      float *jx = jacobian + 3 * f * n + at, *jy = jx + n, *jz = jy + n;
#pragma omp simd
      for (int64_t j = 0; j < count; j++) {
        const float fx = fraction[j], fy = fraction[block + j], fz = fraction[2 * block + j];
        const float p0 = p[j], p1 = p[block + j], p2 = p[2 * block + j], p3 = p[3 * block + j];
        const float p4 = p[4 * block + j], p5 = p[5 * block + j], p6 = p[6 * block + j], p7 = p[7 * block + j];
        const float dx0 = (p1 - p0) + fy * ((p3 - p2) - (p1 - p0)), dx1 = (p5 - p4) + fy * ((p7 - p6) - (p5 - p4));
        const float a = p0 + fx * (p1 - p0), b = p2 + fx * (p3 - p2), c = p4 + fx * (p5 - p4), d = p6 + fx * (p7 - p6);
        const float low = a + fy * (b - a), high = c + fy * (d - c);
        jx[j] = level.scale * (dx0 + fz * (dx1 - dx0));
        jy[j] = level.scale * ((b - a) + fz * ((d - c) - (b - a)));
        jz[j] = level.scale * (high - low);
        out[j] = low + fz * (high - low);
      }
    }
  }
}

template <bool hashed>
void scatter(const float* x, const float* g, const Level& level, int64_t n, float* gradient) {
  alignas(64) uint32_t corner[8 * block];
  alignas(64) float fraction[3 * block], weight[8 * block];
  for (int64_t at = 0; at < n; at += block) {
    const int64_t count = std::min(block, n - at);
    corners<hashed>(x, level, at, count, corner, fraction);
    for (int k = 0; k < 8; k++) {
#pragma omp simd
      for (int64_t j = 0; j < count; j++) {
        const float fx = fraction[j], fy = fraction[block + j], fz = fraction[2 * block + j];
        weight[k * block + j] = (k & 1 ? fx : 1 - fx) * (k & 2 ? fy : 1 - fy) * (k & 4 ? fz : 1 - fz);
      }
    }
    const float *g0 = g + at, *g1 = g + n + at;
    for (int64_t j = 0; j < count; j++)
      for (int k = 0; k < 8; k++) {
        float* entry = gradient + 2 * int64_t(corner[k * block + j]);
        const float w = weight[k * block + j];
        entry[0] += w * g0[j], entry[1] += w * g1[j];
      }
  }
}

void adam_touched(float* p, float* g, float* m, float* v, int64_t size, const float* a) {
  const float rate = a[0], beta1 = a[1], beta2 = a[2], epsilon = a[3], correction1 = a[4], correction2 = a[5];
  for (int64_t i = 0; i < size; i += 16) {
    float largest = 0;
#pragma omp simd reduction(max : largest)
    for (int j = 0; j < 16; j++) largest = std::max(largest, std::fabs(g[i + j]));
    if (largest == 0) continue;
#pragma omp simd
    for (int k = 0; k < 16; k++) {
      const int64_t j = i + k;
      const float gj = g[j], mj = beta1 * m[j] + (1 - beta1) * gj, vj = beta2 * v[j] + (1 - beta2) * gj * gj;
      const float pj = p[j] - rate * (mj * correction1) / (std::sqrt(vj) * correction2 + epsilon);
      const bool touched = gj != 0;
      m[j] = touched ? mj : m[j], v[j] = touched ? vj : v[j], p[j] = touched ? pj : p[j];
      g[j] = 0;
    }
  }
}

Level level_of(const float* scale, const uint32_t* stride, const int64_t* offset, int64_t l) {
  return {scale[l], stride[l], uint32_t(offset[l + 1] - offset[l] - 1), offset[l], offset[l + 1] - offset[l]};
}

}  // namespace

extern "C" {

void encode(const float* x, int64_t n, const float* table, const float* scale, const uint32_t* stride,
            const uint8_t* hashed, const int64_t* offset, int64_t levels, float* features, float* jacobian, int threads) {
  const int64_t chunks = (n + chunk - 1) / chunk;
#pragma omp parallel for schedule(dynamic, 1) num_threads(threads)
  for (int64_t task = 0; task < levels * chunks; task++) {
    const int64_t l = task / chunks, begin = task % chunks * chunk, end = std::min(n, begin + chunk);
    const Level level = level_of(scale, stride, offset, l);
    auto run = hashed[l] ? forward<true> : forward<false>;
    run(x, table + 2 * level.first, level, begin, end, n, features + 2 * l * n, jacobian + 6 * l * n);
  }
}

void position_gradient(const float* g, const float* jacobian, int64_t levels, int64_t n, float* dx, int threads) {
  const int64_t size = 1024;
#pragma omp parallel for schedule(static) num_threads(threads)
  for (int64_t begin = 0; begin < n; begin += size) {
    const int64_t count = std::min(size, n - begin);
    for (int axis = 0; axis < 3; axis++) {
      float* sum = dx + axis * n + begin;
      std::memset(sum, 0, sizeof(float) * count);
      for (int64_t l = 0; l < levels; l++) {
        const float *g0 = g + 2 * l * n + begin, *g1 = g0 + n;
        const float *j0 = jacobian + (6 * l + axis) * n + begin, *j1 = j0 + 3 * n;
#pragma omp simd
        for (int64_t i = 0; i < count; i++) sum[i] += g0[i] * j0[i] + g1[i] * j1[i];
      }
    }
  }
}

// `scratch` holds one zeroed gradient of the largest level per thread; `adam` rate, betas, epsilon, corrections.
void update_table(const float* x, int64_t n, const float* g, const float* scale, const uint32_t* stride,
                  const uint8_t* hashed, const int64_t* offset, int64_t levels, float* table, float* moment1,
                  float* moment2, const float* adam, float* scratch, int64_t largest, int threads) {
  const int64_t chunks = threads;
#pragma omp parallel for schedule(dynamic, 1) num_threads(threads)
  for (int64_t worker = 0; worker < chunks; worker++) {
    float* gradient = scratch + 2 * largest * worker;
    for (int64_t l = worker; l < levels; l += chunks) {
      const Level level = level_of(scale, stride, offset, l);
      (hashed[l] ? scatter<true> : scatter<false>)(x, g + 2 * l * n, level, n, gradient);
      const int64_t at = 2 * level.first;
      adam_touched(table + at, gradient, moment1 + at, moment2 + at, 2 * level.entries, adam);
    }
  }
}
}
