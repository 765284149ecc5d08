// Rasteriser of 3D Gaussians with gradients, for CPUs. C ABI, C++17, no dependencies, own threads.
//
// One call renders one view. The plan:
//   project   every Gaussian once, one per lane of a vector -> a compact record, a tile rectangle and a depth key
//   order     stable radix sort of the Gaussians (not of the intersections) by the bits of their depth
//   bin       stable counting sort of the ordered Gaussians into tiles, in bands of tile rows when memory would not do
//   blend     per tile, front to back: windows of kColumns x kRows pixels over a Gaussian's box
//   backward  per tile, front to back again, each (Gaussian, tile) pair writes sums into a slot of its own;
//             then per Gaussian, the slots are summed in a fixed order and carried through the projection
// Nothing depends on how work was dealt to threads: the results are the same bits for every thread count.
//
// Pixels of a tile live in rows padded by one window, so that a window may start at any column. Where a window covers two rows,
// these lie interleaved pixel by pixel: most boxes are about eight pixels wide, and half of a vector of sixteen would be wasted on
// one row. A pixel that takes no more light has a transmittance <= 0, so padding (0) and finished pixels (negated) need no mask.
//
// Vectors are GCC/Clang vector types of the machine's own width: loops over bool masks are not vectorised reliably.

#include <algorithm>
#include <atomic>
#include <cmath>
#include <condition_variable>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <exception>
#include <functional>
#include <limits>
#include <memory>
#include <mutex>
#include <new>
#include <thread>
#include <utility>
#include <vector>

#if defined(__linux__)
#include <sys/mman.h>
#endif

#define SX_API extern "C" __attribute__((visibility("default")))
#define SX_INLINE inline __attribute__((always_inline))

namespace {

#if defined(__AVX512F__)
constexpr int kLanes = 16;
#elif defined(__AVX__)
constexpr int kLanes = 8;
#else
constexpr int kLanes = 4;
#endif

typedef float Vec __attribute__((vector_size(4 * kLanes)));
typedef int32_t Mask __attribute__((vector_size(4 * kLanes)));

constexpr int kTileW = 16;
constexpr int kTileH = 16;
constexpr int kRows = kLanes == 16 ? 2 : 1;  // of a window
constexpr int kColumns = kLanes / kRows;
constexpr int kStride = (kTileW + kColumns) * kRows;  // from one group of kRows rows of tile pixels to the next, see above
constexpr int kPixels = kTileH / kRows * kStride;
constexpr int kMoments = 6;        // sums over pixels: v, v dx, v dy, v dx^2, v dx dy, v dy^2
constexpr int kDoneEvery = 16;     // Gaussians between two tests whether a tile is finished
constexpr int kAhead = 8;          // Gaussians by which records are fetched ahead: a tile's lie all over memory
constexpr int kDigitBits = 12;     // most bits of a depth that one pass of the sort takes
constexpr int kChunk = 2048;       // Gaussians per unit of work; fixed, so that partial sums do not depend on threads
static_assert(kChunk % kLanes == 0, "a chunk is whole vectors of Gaussians");
constexpr float kMinAlpha = 1.0f / 255.0f;
constexpr float kMinTransmittance = 1e-4f;
constexpr float kMinDeterminant = 1e-10f;
constexpr float kMinCompensation = 0.005f;
constexpr float kJacobianMargin = 0.15f;  // of the image size, beyond which the local affine map is frozen
constexpr float kLog2E = 1.4426950408889634f;
constexpr uint32_t kCulled = 0xffffffffu;

// ------------------------------------------------------------------------------------------------ small tools

SX_INLINE Vec load(const float* p) {
  Vec v;
  std::memcpy(&v, p, sizeof v);
  return v;
}
SX_INLINE void store(float* p, Vec v) { std::memcpy(p, &v, sizeof v); }
SX_INLINE Vec splat(float x) { return Vec{} + x; }
SX_INLINE Vec keep(Mask mask, Vec v) { return (Vec)((Mask)v & mask); }  // v where the mask holds, else 0
SX_INLINE int pixel_at(int x, int y) { return y / kRows * kStride + x * kRows + y % kRows; }  // in a tile
SX_INLINE Vec column_of_lane() {
  Vec v{};
  for (int lane = 0; lane < kLanes; ++lane) v[lane] = static_cast<float>(lane / kRows);
  return v;
}
SX_INLINE Vec row_of_lane() {
  Vec v{};
  for (int lane = 0; lane < kLanes; ++lane) v[lane] = static_cast<float>(lane % kRows);
  return v;
}
SX_INLINE float lane_sum(Vec v) {
  float lanes[kLanes];
  store(lanes, v);
  for (int half = kLanes / 2; half > 0; half /= 2)
    for (int i = 0; i < half; ++i) lanes[i] += lanes[i + half];
  return lanes[0];
}

SX_INLINE bool any(Mask mask) {
  int32_t lanes[kLanes], found = 0;
  std::memcpy(lanes, &mask, sizeof lanes);
  for (int32_t lane : lanes) found |= lane;
  return found != 0;
}
template <class Fn>
SX_INLINE Vec each_lane(Vec v, const Fn& fn) {
  float lanes[kLanes];
  store(lanes, v);
  for (float& lane : lanes) lane = fn(lane);
  return load(lanes);
}
SX_INLINE Vec sqrt_vec(Vec v) {
  return each_lane(v, [](float x) { return std::sqrt(x); });
}
SX_INLINE Vec ceil_vec(Vec v) {
  return each_lane(v, [](float x) { return std::ceil(x); });
}
SX_INLINE Vec floor_vec(Vec v) {
  return each_lane(v, [](float x) { return std::floor(x); });
}
SX_INLINE Vec max_vec(Vec a, Vec b) { return a < b ? b : a; }
SX_INLINE Vec min_vec(Vec a, Vec b) { return b < a ? b : a; }

// Up to kLanes rows of W floats as W vectors, a row in each lane; zeros in the lanes without a row.
template <int W>
SX_INLINE void load_rows(const float* rows, int count, Vec* out) {
  float columns[W][kLanes] = {};
  for (int lane = 0; lane < count; ++lane)
    for (int i = 0; i < W; ++i) columns[i][lane] = rows[lane * W + i];
  for (int i = 0; i < W; ++i) out[i] = load(columns[i]);
}

// out[i] = sum of the lanes of v[i]. Eight vectors at a time by adding shuffled pairs, where the compiler has shuffles.
template <int N>
SX_INLINE void lane_sums(const Vec* v, float* out) {
  int done = 0;
#if defined(__has_builtin)
#if __has_builtin(__builtin_shufflevector)
  typedef float Oct __attribute__((vector_size(32)));
  for (; kLanes >= 8 && done + 8 <= N; done += 8) {
    Oct a[8];
    for (int i = 0; i < 8; ++i) {
      std::memcpy(&a[i], &v[done + i], sizeof(Oct));
      if (kLanes == 16) {
        Oct high;
        std::memcpy(&high, reinterpret_cast<const char*>(&v[done + i]) + (sizeof(Vec) - sizeof(Oct)), sizeof(Oct));
        a[i] += high;
      }
    }
    for (int i = 0; i < 4; ++i)
      a[i] = __builtin_shufflevector(a[2 * i], a[2 * i + 1], 0, 8, 2, 10, 4, 12, 6, 14) +
             __builtin_shufflevector(a[2 * i], a[2 * i + 1], 1, 9, 3, 11, 5, 13, 7, 15);
    for (int i = 0; i < 2; ++i)
      a[i] = __builtin_shufflevector(a[2 * i], a[2 * i + 1], 0, 1, 8, 9, 4, 5, 12, 13) +
             __builtin_shufflevector(a[2 * i], a[2 * i + 1], 2, 3, 10, 11, 6, 7, 14, 15);
    a[0] = __builtin_shufflevector(a[0], a[1], 0, 1, 2, 3, 8, 9, 10, 11) +
           __builtin_shufflevector(a[0], a[1], 4, 5, 6, 7, 12, 13, 14, 15);
    std::memcpy(out + done, &a[0], sizeof(Oct));
  }
#endif
#endif
  for (; done < N; ++done) out[done] = lane_sum(v[done]);
}

// 2^t by a polynomial on [-1/2, 1/2] (relative error 7.5e-8); meaningless below t = -126, where callers mask it.
SX_INLINE Vec exp2_vec(Vec t) {
  const Vec magic = splat(12582912.0f);  // 1.5 * 2^23: adding it rounds to an integer, held in the low mantissa bits
  const Vec shifted = t + magic;
  const Vec f = t - (shifted - magic);
  Vec p = splat(1.32764641e-3f);
  p = p * f + 9.67554127e-3f;
  p = p * f + 5.5507133e-2f;
  p = p * f + 2.40221197e-1f;
  p = p * f + 6.93146967e-1f;
  p = p * f + 1.00000007f;
  return (Vec)((Mask)p + ((Mask)shifted << 23));
}

// The threads of one call: the caller and its helpers. They end with the call, so a process may fork between calls.
class Team {
 public:
  explicit Team(int threads) : parts_(std::max(1, threads)) {
    for (int i = 1; i < parts_; ++i) {
      try {
        helpers_.emplace_back([this] { help(); });
      } catch (const std::exception&) {
        break;  // the system gives no more threads: fewer do the same work
      }
    }
  }
  ~Team() {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      ended_ = true;
    }
    wake_.notify_all();
    for (auto& helper : helpers_) helper.join();
  }
  Team(const Team&) = delete;
  Team& operator=(const Team&) = delete;

  // Into how many parts to cut work that cannot be dealt out piece by piece.
  int64_t parts() const { return parts_; }

  // Runs fn(0..count-1), every thread pulling the next index. Rethrows the first exception. A helper that has not woken up by
  // the time the work is dealt out is not waited for: on a busy machine that would take longer than the work.
  template <class Fn>
  void run(int64_t count, const Fn& fn) {
    std::atomic<int64_t> next{0};
    std::exception_ptr failure;
    std::atomic<bool> failed{false};
    const std::function<void()> work = [&] {
      try {
        for (int64_t i; (i = next.fetch_add(1, std::memory_order_relaxed)) < count;) fn(i);
      } catch (...) {
        if (!failed.exchange(true)) failure = std::current_exception();
      }
    };
    if (count > 1 && !helpers_.empty()) {
      {
        const std::lock_guard<std::mutex> lock(mutex_);
        work_ = &work, ++round_;
      }
      wake_.notify_all();
    }
    work();
    {
      std::unique_lock<std::mutex> lock(mutex_);
      work_ = nullptr;
      done_.wait(lock, [&] { return busy_ == 0; });
    }
    if (failure) std::rethrow_exception(failure);
  }

 private:
  void help() {
    std::unique_lock<std::mutex> lock(mutex_);
    for (uint64_t last = 0;;) {
      wake_.wait(lock, [&] { return ended_ || (work_ && round_ != last); });
      if (ended_) return;
      last = round_;
      const std::function<void()>& work = *work_;
      ++busy_;
      lock.unlock();
      work();
      lock.lock();
      if (--busy_ == 0) done_.notify_one();
    }
  }

  const int parts_;
  std::vector<std::thread> helpers_;
  std::mutex mutex_;  // of all below
  std::condition_variable wake_, done_;
  const std::function<void()>* work_ = nullptr;
  uint64_t round_ = 0;
  int busy_ = 0;
  bool ended_ = false;
};

struct Free {
  void operator()(void* p) const { std::free(p); }
};
template <class T>
using Buffer = std::unique_ptr<T[], Free>;

// Every call takes and returns tens of megabytes: in pages of 4 KiB, each of which the system hands over by itself, that costs a
// tenth of the time. Large buffers ask for pages of 2 MiB, and for all of them from one thread: two threads that are the first to
// touch a page would both clear one.
template <class T>
Buffer<T> uninitialised(size_t count) {
  constexpr size_t kHuge = size_t{1} << 21;
  const size_t bytes = std::max<size_t>(count * sizeof(T), 1);
  const size_t align = bytes >= 2 * kHuge ? kHuge : 64;
  void* p = std::aligned_alloc(align, (bytes + align - 1) / align * align);
  if (!p) throw std::bad_alloc();
#if defined(__linux__)
  if (align == kHuge) {
    madvise(p, bytes, MADV_HUGEPAGE);  // a wish: nothing depends on the answer
    for (size_t at = 0; at < bytes; at += kHuge) static_cast<char*>(p)[at] = 0;
  }
#endif
  return Buffer<T>(static_cast<T*>(p));
}

}  // namespace

// ------------------------------------------------------------------------------------------------ C ABI structures

// Mirrored by ctypes in kernel_backend.py: keep the two in step.
struct SxScene {
  int64_t count;
  int64_t band_bytes;  // budget for one band's intersections
  int32_t width, height;
  int32_t sh_coefficients;  // per colour channel; 0: colours are RGB
  int32_t with_depth;       // camera z as a channel after RGB
  int32_t extra_channels;
  int32_t antialiased;
  int32_t threads;
  float near_plane, far_plane, eps2d, max_alpha;
  const float* means;           // [N,3]
  const float* quats;           // [N,4] wxyz, any length
  const float* scales;          // [N,3]
  const float* opacities;       // [N]
  const float* colours;         // [N,3] or [N,sh_coefficients,3]
  const float* extras;          // [N,extra_channels] or null
  const float* offsets;         // [N,2] added to the projected means, or null
  const float* cam_from_world;  // [4,4]
  const float* intrinsics;      // [3,3]
};

// Gradients of what views share are added to what the buffers hold if `add`; all others are set.
struct SxGradients {
  int32_t add;
  float *means, *quats, *scales, *opacities, *colours;
  float* extras;          // or null
  float* offsets;         // or null
  float* cam_from_world;  // [4,4]
};

namespace {

// ------------------------------------------------------------------------------------------------ projection

struct Camera {
  float r[9], t[3], position[3];
  float fx, fy, cx, cy;
  float x_low, x_high, y_low, y_high;  // limits of x/z and y/z inside the Jacobian

  explicit Camera(const SxScene& s) {
    const float* m = s.cam_from_world;
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) r[3 * i + j] = m[4 * i + j];
      t[i] = m[4 * i + 3];
    }
    for (int j = 0; j < 3; ++j) position[j] = -(r[j] * t[0] + r[3 + j] * t[1] + r[6 + j] * t[2]);
    fx = s.intrinsics[0], fy = s.intrinsics[4], cx = s.intrinsics[2], cy = s.intrinsics[5];
    const float w = static_cast<float>(s.width), h = static_cast<float>(s.height);
    x_low = -(cx + kJacobianMargin * w) / fx, x_high = (w - cx + kJacobianMargin * w) / fx;
    y_low = -(cy + kJacobianMargin * h) / fy, y_high = (h - cy + kJacobianMargin * h) / fy;
  }
};

template <class A, class B>
SX_INLINE B dot3(const A* a, const B* b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

// Everything between kLanes Gaussians, one per lane, and their ellipses on the image; the backward pass recomputes it.
struct Projection {
  Vec m[3], scale[3];      // as given
  Vec p[3];                // mean in the camera frame
  Vec inv_z, rx, ry;       // 1/z, clamped x/z and y/z
  Mask x_free, y_free;     // not clamped
  Vec q[4], inv_norm;      // unit quaternion, 1/length of the given one
  Vec rot[9];              // world_from_gaussian
  Vec a[9];                // cam_from_gaussian, scaled: R * rot * diag(s)
  Vec j00, j02, j11, j12;  // Jacobian
  Vec v0[3], v1[3];        // rows of J * a: cov = v v^T
  Vec xx, xy, yy;          // covariance before the blur
  Vec det0, det1;          // determinants before and after the blur
  Vec bx, by;              // diagonal after the blur
  Vec given_opacity;
  Vec compensation;        // of the opacity, antialiased mode
  Vec opacity;             // compensated
  Vec u, v;                // mean on the image
};

SX_INLINE void rotation_from_quat(const Vec* q, Vec* m) {
  const Vec w = q[0], x = q[1], y = q[2], z = q[3];
  m[0] = 1.0f - 2.0f * (y * y + z * z), m[1] = 2.0f * (x * y - w * z), m[2] = 2.0f * (x * z + w * y);
  m[3] = 2.0f * (x * y + w * z), m[4] = 1.0f - 2.0f * (x * x + z * z), m[5] = 2.0f * (y * z - w * x);
  m[6] = 2.0f * (x * z - w * y), m[7] = 2.0f * (y * z + w * x), m[8] = 1.0f - 2.0f * (x * x + y * y);
}

// Of the Gaussians from g on, which can be seen; the lanes of others mean nothing. Tests are written so that NaN fails them.
SX_INLINE Mask project(const SxScene& s, const Camera& cam, int64_t g, Projection& o) {
  const int n = static_cast<int>(std::min<int64_t>(s.count - g, kLanes));
  load_rows<3>(s.means + 3 * g, n, o.m);
  load_rows<1>(s.opacities + g, n, &o.given_opacity);
  for (int i = 0; i < 3; ++i) o.p[i] = dot3(cam.r + 3 * i, o.m) + cam.t[i];
  const Vec z = o.p[2];
  Mask seen = (z > s.near_plane) & (z < s.far_plane) & (o.given_opacity >= kMinAlpha);
  if (!any(seen)) return seen;

  load_rows<4>(s.quats + 4 * g, n, o.q);
  o.inv_norm = 1.0f / sqrt_vec(o.q[0] * o.q[0] + o.q[1] * o.q[1] + o.q[2] * o.q[2] + o.q[3] * o.q[3]);
  for (int i = 0; i < 4; ++i) o.q[i] *= o.inv_norm;
  rotation_from_quat(o.q, o.rot);
  load_rows<3>(s.scales + 3 * g, n, o.scale);
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      o.a[3 * i + j] =
          (cam.r[3 * i] * o.rot[j] + cam.r[3 * i + 1] * o.rot[3 + j] + cam.r[3 * i + 2] * o.rot[6 + j]) * o.scale[j];

  o.inv_z = 1.0f / z;
  const Vec x_ratio = o.p[0] * o.inv_z, y_ratio = o.p[1] * o.inv_z;
  o.rx = min_vec(max_vec(x_ratio, splat(cam.x_low)), splat(cam.x_high));
  o.ry = min_vec(max_vec(y_ratio, splat(cam.y_low)), splat(cam.y_high));
  o.x_free = o.rx == x_ratio, o.y_free = o.ry == y_ratio;
  o.j00 = cam.fx * o.inv_z, o.j02 = -cam.fx * o.rx * o.inv_z;
  o.j11 = cam.fy * o.inv_z, o.j12 = -cam.fy * o.ry * o.inv_z;
  for (int j = 0; j < 3; ++j) {
    o.v0[j] = o.j00 * o.a[j] + o.j02 * o.a[6 + j];
    o.v1[j] = o.j11 * o.a[3 + j] + o.j12 * o.a[6 + j];
  }
  o.xx = dot3(o.v0, o.v0), o.xy = dot3(o.v0, o.v1), o.yy = dot3(o.v1, o.v1);
  o.bx = o.xx + s.eps2d, o.by = o.yy + s.eps2d;
  // |v0 x v1|^2 cannot turn negative, xx * yy - xy^2 can.
  const Vec n0 = o.v0[1] * o.v1[2] - o.v0[2] * o.v1[1];
  const Vec n1 = o.v0[2] * o.v1[0] - o.v0[0] * o.v1[2];
  const Vec n2 = o.v0[0] * o.v1[1] - o.v0[1] * o.v1[0];
  o.det0 = n0 * n0 + n1 * n1 + n2 * n2;
  o.det1 = o.det0 + s.eps2d * (o.xx + o.yy) + s.eps2d * s.eps2d;

  o.compensation = splat(1.0f);
  if (s.antialiased) o.compensation = max_vec(splat(kMinCompensation), sqrt_vec(o.det0 / o.det1));
  o.opacity = o.given_opacity * o.compensation;
  o.u = cam.fx * x_ratio + cam.cx, o.v = cam.fy * y_ratio + cam.cy;
  if (s.offsets) {
    Vec offset[2];
    load_rows<2>(s.offsets + 2 * g, n, offset);
    o.u += offset[0], o.v += offset[1];
  }
  return seen & (o.det1 > kMinDeterminant) & (o.opacity >= kMinAlpha);
}

// ------------------------------------------------------------------------------------------------ spherical harmonics

// Real spherical harmonics up to degree 3 in the usual 3DGS order and signs.
SX_INLINE void sh_basis(int coefficients, float x, float y, float z, float* b) {
  b[0] = 0.28209479177387814f;
  if (coefficients <= 1) return;
  b[1] = -0.4886025119029199f * y, b[2] = 0.4886025119029199f * z, b[3] = -0.4886025119029199f * x;
  if (coefficients <= 4) return;
  const float xx = x * x, yy = y * y, zz = z * z;
  b[4] = 1.0925484305920792f * x * y, b[5] = -1.0925484305920792f * y * z;
  b[6] = 0.31539156525252005f * (2 * zz - xx - yy);
  b[7] = -1.0925484305920792f * x * z, b[8] = 0.5462742152960396f * (xx - yy);
  if (coefficients <= 9) return;
  b[9] = -0.5900435899266435f * y * (3 * xx - yy), b[10] = 2.890611442640554f * x * y * z;
  b[11] = -0.4570457994644658f * y * (4 * zz - xx - yy);
  b[12] = 0.3731763325901154f * z * (2 * zz - 3 * xx - 3 * yy);
  b[13] = -0.4570457994644658f * x * (4 * zz - xx - yy);
  b[14] = 1.445305721320277f * z * (xx - yy), b[15] = -0.5900435899266435f * x * (xx - 3 * yy);
}

// d/d(x, y, z) of sum_k weight[k] * basis[k](x, y, z).
SX_INLINE void sh_gradient(int coefficients, float x, float y, float z, const float* w, float* d) {
  d[0] = d[1] = d[2] = 0;
  if (coefficients <= 1) return;
  d[0] += -0.4886025119029199f * w[3], d[1] += -0.4886025119029199f * w[1], d[2] += 0.4886025119029199f * w[2];
  if (coefficients <= 4) return;
  const float c0 = 1.0925484305920792f, c1 = 0.31539156525252005f, c2 = 0.5462742152960396f;
  d[0] += c0 * (y * w[4] - z * w[7]) - 2 * c1 * x * w[6] + 2 * c2 * x * w[8];
  d[1] += c0 * (x * w[4] - z * w[5]) - 2 * c1 * y * w[6] - 2 * c2 * y * w[8];
  d[2] += -c0 * (y * w[5] + x * w[7]) + 4 * c1 * z * w[6];
  if (coefficients <= 9) return;
  const float xx = x * x, yy = y * y, zz = z * z;
  const float k0 = 0.5900435899266435f, k1 = 2.890611442640554f, k2 = 0.4570457994644658f;
  const float k3 = 0.3731763325901154f, k4 = 1.445305721320277f;
  d[0] += -6 * k0 * x * y * w[9] + k1 * y * z * w[10] + 2 * k2 * x * y * w[11] - 6 * k3 * x * z * w[12] -
          k2 * (4 * zz - 3 * xx - yy) * w[13] + 2 * k4 * x * z * w[14] - 3 * k0 * (xx - yy) * w[15];
  d[1] += -3 * k0 * (xx - yy) * w[9] + k1 * x * z * w[10] - k2 * (4 * zz - xx - 3 * yy) * w[11] -
          6 * k3 * y * z * w[12] + 2 * k2 * x * y * w[13] - 2 * k4 * y * z * w[14] + 6 * k0 * x * y * w[15];
  d[2] += k1 * x * y * w[10] - 8 * k2 * y * z * w[11] + k3 * (6 * zz - 3 * xx - 3 * yy) * w[12] -
          8 * k2 * x * z * w[13] + k4 * (xx - yy) * w[14];
}

struct Direction {
  float d[3], inv_length;
};

SX_INLINE Direction view_direction(const SxScene& s, const Camera& cam, int64_t g) {
  Direction out;
  float length2 = 0;
  for (int i = 0; i < 3; ++i) {
    out.d[i] = s.means[3 * g + i] - cam.position[i];
    length2 += out.d[i] * out.d[i];
  }
  out.inv_length = length2 > 0 ? 1.0f / std::sqrt(length2) : 0.0f;
  for (float& component : out.d) component *= out.inv_length;
  return out;
}

SX_INLINE void shade(const SxScene& s, const Camera& cam, int64_t g, float* rgb) {
  const int n = s.sh_coefficients;
  if (n == 0) {
    for (int c = 0; c < 3; ++c) rgb[c] = s.colours[3 * g + c];
    return;
  }
  float basis[16];
  const Direction dir = view_direction(s, cam, g);
  sh_basis(n, dir.d[0], dir.d[1], dir.d[2], basis);
  const float* sh = s.colours + static_cast<int64_t>(3) * n * g;
  rgb[0] = rgb[1] = rgb[2] = 0.5f;
  for (int k = 0; k < n; ++k)
    for (int c = 0; c < 3; ++c) rgb[c] += basis[k] * sh[3 * k + c];
  for (int c = 0; c < 3; ++c) rgb[c] = std::max(rgb[c], 0.0f);
}

// ------------------------------------------------------------------------------------------------ a view

// What blending needs of a Gaussian: log2(alpha) = level + qa dx^2 + qb dx dy + qc dy^2, box in pixels (end exclusive).
template <int NC>
struct alignas(64) Record {
  float u, v, qa, qb, qc, level;
  int16_t x0, x1, y0, y1;
  float feature[NC];
};

struct Rect {
  uint16_t x0, x1, y0, y1;  // in tiles, end exclusive; empty where culled
};

SX_INLINE bool is_seen(const Rect& r) { return r.x0 < r.x1; }

// How many of a Gaussian's tiles lie in the tile rows row0 to row1 (exclusive).
SX_INLINE int64_t tiles_in(const Rect& r, int row0, int row1) {
  return static_cast<int64_t>(r.x1 - r.x0) * std::max(0, std::min<int>(r.y1, row1) - std::max<int>(r.y0, row0));
}

struct Bins {  // Gaussians of each tile of a band, in depth order
  int row0 = 0, row1 = 0;
  std::vector<uint64_t> start;
  Buffer<uint32_t> entries;
};

struct View {
  int64_t count = 0, visible = 0;
  int64_t pairs = 0;  // of a visible Gaussian and a tile
  int tiles_x = 0, tiles_y = 0, channels = 0;
  Buffer<Rect> rects;      // by Gaussian
  Buffer<uint32_t> order;  // visible Gaussians by depth
  Buffer<Rect> ordered_rects;
  std::vector<int> bands;  // boundaries in tile rows
  Bins bins;               // kept for the backward pass if there is only one band
  virtual ~View() = default;
};

template <int NC>
struct ViewOf : View {
  Buffer<Record<NC>> records;  // by Gaussian; only those of visible ones are set
};

int channels_of(const SxScene& s) { return 3 + (s.with_depth ? 1 : 0) + s.extra_channels; }

int64_t chunks_of(int64_t count) { return (count + kChunk - 1) / kChunk; }

// Calls fn(g) for the Gaussians of a chunk.
template <class Fn>
SX_INLINE void each_of_chunk(int64_t chunk, int64_t count, const Fn& fn) {
  for (int64_t g = chunk * kChunk; g < std::min<int64_t>(count, (chunk + 1) * kChunk); ++g) fn(g);
}

// No more threads than there are units of work.
int threads_for(const SxScene& s) {
  const int64_t tiles = static_cast<int64_t>((s.width + kTileW - 1) / kTileW) * ((s.height + kTileH - 1) / kTileH);
  return static_cast<int>(std::min<int64_t>(s.threads, std::max(tiles, chunks_of(s.count))));
}

struct DepthKeys {
  Buffer<uint32_t> key;         // by Gaussian, kCulled where it cannot be seen
  std::vector<int64_t> before;  // visible Gaussians before each chunk
  uint32_t least = kCulled, most = 0;
};

// Of a chunk, so that nobody has to go through all Gaussians alone.
struct SeenCount {
  int64_t visible = 0, pairs = 0;
  uint32_t least = kCulled, most = 0;
};

// Records, rectangles, depths and radii of the up to kLanes Gaussians from g on.
template <int NC>
void make_records(const SxScene& s, const Camera& cam, int64_t g, ViewOf<NC>& view, uint32_t* keys, float* radii,
                  SeenCount& count) {
  const int n = static_cast<int>(std::min<int64_t>(s.count - g, kLanes));
  std::fill_n(keys + g, n, kCulled);
  std::fill_n(radii + g, n, 0.0f);
  std::fill_n(view.rects.get() + g, n, Rect{0, 0, 0, 0});
  Projection o;
  Mask seen = project(s, cam, g, o);
  if (!any(seen)) return;
  // alpha >= 1/255 inside this ellipse only; the margin absorbs rounding.
  const Vec opacity = seen ? o.opacity : splat(1.0f);  // logarithms of lanes that mean nothing may be slow
  const Vec extent = 2.0f * each_lane(255.0f * opacity, [](float x) { return std::log(x); }) + 1e-4f;
  const Vec level = each_lane(opacity, [](float x) { return std::log2(x); });
  const Vec half_w = sqrt_vec(extent * o.bx), half_h = sqrt_vec(extent * o.by);
  const Vec w = splat(static_cast<float>(s.width)), h = splat(static_cast<float>(s.height));
  const Vec x0 = max_vec(ceil_vec(o.u - half_w - 0.5f), Vec{}), x1 = min_vec(floor_vec(o.u + half_w + 0.5f), w);
  const Vec y0 = max_vec(ceil_vec(o.v - half_h - 0.5f), Vec{}), y1 = min_vec(floor_vec(o.v + half_h + 0.5f), h);
  seen &= (x0 < x1) & (y0 < y1);
  const Vec radius = max_vec(half_w, half_h);
  const Vec k = -0.5f * kLog2E / o.det1;
  const Vec qa = k * o.by, qb = -2.0f * k * o.xy, qc = k * o.bx;
  for (int lane = 0; lane < n; ++lane) {
    if (!seen[lane]) continue;
    const int64_t at = g + lane;
    const float z = o.p[2][lane];
    Record<NC>& rec = view.records[at];
    rec.u = o.u[lane], rec.v = o.v[lane];
    rec.qa = qa[lane], rec.qb = qb[lane], rec.qc = qc[lane];
    rec.level = level[lane];
    rec.x0 = static_cast<int16_t>(x0[lane]), rec.x1 = static_cast<int16_t>(x1[lane]);
    rec.y0 = static_cast<int16_t>(y0[lane]), rec.y1 = static_cast<int16_t>(y1[lane]);
    std::fill(rec.feature, rec.feature + NC, 0.0f);
    shade(s, cam, at, rec.feature);
    float* rest = rec.feature + 3;
    if (s.with_depth) *rest++ = z;
    if (s.extra_channels) std::copy_n(s.extras + at * s.extra_channels, s.extra_channels, rest);
    radii[at] = radius[lane];
    const Rect rect{static_cast<uint16_t>(rec.x0 / kTileW), static_cast<uint16_t>((rec.x1 - 1) / kTileW + 1),
                    static_cast<uint16_t>(rec.y0 / kTileH), static_cast<uint16_t>((rec.y1 - 1) / kTileH + 1)};
    view.rects[at] = rect;
    std::memcpy(&keys[at], &z, sizeof z);  // positive floats order like their bits
    count.visible += 1, count.pairs += tiles_in(rect, 0, view.tiles_y);
    count.least = std::min(count.least, keys[at]), count.most = std::max(count.most, keys[at]);
  }
}

template <int NC>
void project_all(const SxScene& s, Team& team, const Camera& cam, ViewOf<NC>& view, DepthKeys& keys, float* radii) {
  std::vector<SeenCount> counts(chunks_of(s.count));
  keys.key = uninitialised<uint32_t>(s.count);
  team.run(chunks_of(s.count), [&](int64_t chunk) {
    SeenCount own;
    for (int64_t g = chunk * kChunk; g < std::min<int64_t>(s.count, (chunk + 1) * kChunk); g += kLanes)
      make_records<NC>(s, cam, g, view, keys.key.get(), radii, own);
    counts[chunk] = own;
  });
  keys.before.reserve(counts.size());
  for (const SeenCount& part : counts) {
    keys.before.push_back(view.visible);
    view.visible += part.visible, view.pairs += part.pairs;
    keys.least = std::min(keys.least, part.least), keys.most = std::max(keys.most, part.most);
  }
}

// Stable radix sort of the visible Gaussians by key, in digits of equal width from the lowest. Each part of the list counts, then
// writes behind the parts before it: there is only one stable order, so the number of parts does not show.
void order_by_depth(Team& team, const DepthKeys& keys, View& view) {
  struct Item {
    uint32_t key, index;
  };
  auto items = uninitialised<Item>(view.visible), other = uninitialised<Item>(view.visible);
  team.run(chunks_of(view.count), [&](int64_t chunk) {
    Item* next = items.get() + keys.before[chunk];
    each_of_chunk(chunk, view.count, [&](int64_t g) {
      if (keys.key[g] != kCulled) *next++ = {keys.key[g] - keys.least, static_cast<uint32_t>(g)};
    });
  });
  const uint32_t spread = view.visible > 0 ? keys.most - keys.least : 0;
  int bits = 0;  // of the spread
  while (bits < 32 && spread >> bits != 0) ++bits;
  const int passes = (bits + kDigitBits - 1) / kDigitBits;
  const int width = passes > 0 ? (bits + passes - 1) / passes : 0;
  const uint32_t digits = 1u << width;
  const int64_t parts = team.parts();
  auto range = [&](int64_t part) { return part * view.visible / parts; };
  std::vector<uint32_t> cursor(parts * digits);
  for (int shift = 0; shift < bits; shift += width) {
    auto digit = [&](const Item& item) { return item.key >> shift & (digits - 1); };
    team.run(parts, [&](int64_t part) {
      uint32_t* mine = cursor.data() + part * digits;
      std::fill(mine, mine + digits, 0);
      for (int64_t i = range(part); i < range(part + 1); ++i) ++mine[digit(items[i])];
    });
    uint32_t total = 0;
    for (uint32_t d = 0; d < digits; ++d)
      for (int64_t part = 0; part < parts; ++part) total += std::exchange(cursor[part * digits + d], total);
    team.run(parts, [&](int64_t part) {
      uint32_t* mine = cursor.data() + part * digits;
      for (int64_t i = range(part); i < range(part + 1); ++i) other[mine[digit(items[i])]++] = items[i];
    });
    items.swap(other);
  }
  view.order = uninitialised<uint32_t>(view.visible);
  view.ordered_rects = uninitialised<Rect>(view.visible);
  team.run(parts, [&](int64_t part) {
    for (int64_t i = range(part); i < range(part + 1); ++i) {
      view.order[i] = items[i].index;
      view.ordered_rects[i] = view.rects[items[i].index];
    }
  });
}

// Greedy bands of whole tile rows, each within the budget where a single row is.
void choose_bands(const SxScene& s, View& view) {
  const int64_t budget = s.band_bytes / static_cast<int64_t>(sizeof(float) * (1 + kMoments + channels_of(s)));
  view.bands = {0, view.tiles_y};
  if (view.pairs <= budget) return;
  std::vector<int64_t> change(view.tiles_y + 1, 0);
  for (int64_t i = 0; i < view.visible; ++i) {
    const Rect& r = view.ordered_rects[i];
    change[r.y0] += r.x1 - r.x0, change[r.y1] -= r.x1 - r.x0;
  }
  view.bands = {0};
  int64_t in_row = 0, in_band = 0;
  for (int row = 0; row < view.tiles_y; ++row) {
    in_row += change[row];
    if (in_band > 0 && in_band + in_row > budget) view.bands.push_back(row), in_band = 0;
    in_band += in_row;
  }
  view.bands.push_back(view.tiles_y);
}

// Calls fn(tile, 1) for the tiles of a Gaussian in a band, and fn(tile, 0) for some of them again: most have one or two columns
// and rows, at random, and loops would be guessed wrong about every other time.
template <class Fn>
SX_INLINE void each_tile(const Rect& r, int row0, int row1, int tiles_x, const Fn& fn) {
  const int y0 = std::max<int>(r.y0, row0) - row0, y1 = std::min<int>(r.y1, row1) - row0;
  const int right = r.x1 - r.x0 - 1, down = y1 - y0 - 1;
  if (down < 0) return;
  if (right <= 1 && down <= 1) {
    const int above = y0 * tiles_x + r.x0, below = above + down * tiles_x;
    fn(above, 1), fn(above + right, right), fn(below, down), fn(below + right, right & down);
    return;
  }
  for (int y = y0; y < y1; ++y)
    for (int x = r.x0; x < r.x1; ++x) fn(y * tiles_x + x, 1);
}

// Stable counting sort: each part of the depth order counts, then writes behind the parts before it.
void fill_bins(const View& view, Team& team, int row0, int row1, Bins& bins) {
  const int64_t tiles = static_cast<int64_t>(row1 - row0) * view.tiles_x;
  const int64_t parts = team.parts();
  std::vector<uint64_t> cursor(parts * tiles, 0);
  auto range = [&](int64_t part) { return part * view.visible / parts; };
  team.run(parts, [&](int64_t part) {
    uint64_t* mine = cursor.data() + part * tiles;
    for (int64_t i = range(part); i < range(part + 1); ++i)
      each_tile(view.ordered_rects[i], row0, row1, view.tiles_x, [&](int tile, int is_new) { mine[tile] += is_new; });
  });
  bins.row0 = row0, bins.row1 = row1;
  bins.start.assign(tiles + 1, 0);
  uint64_t total = 0;
  for (int64_t tile = 0; tile < tiles; ++tile) {
    bins.start[tile] = total;
    for (int64_t part = 0; part < parts; ++part) {
      const uint64_t in_part = cursor[part * tiles + tile];
      cursor[part * tiles + tile] = total;
      total += in_part;
    }
  }
  bins.start[tiles] = total;
  bins.entries = uninitialised<uint32_t>(total);
  team.run(parts, [&](int64_t part) {
    uint64_t* mine = cursor.data() + part * tiles;
    uint32_t* entries = bins.entries.get();
    for (int64_t i = range(part); i < range(part + 1); ++i)
      each_tile(view.ordered_rects[i], row0, row1, view.tiles_x, [&](int tile, int is_new) {
        mine[tile] += is_new;
        entries[mine[tile] - 1] = view.order[i];  // once more the same, unless it is new
      });
  });
}

// ------------------------------------------------------------------------------------------------ blending

struct TileArea {
  int x, y, w, h;  // pixels of the image that the tile covers
};

TileArea tile_area(const SxScene& s, int column, int row) {
  const int x = column * kTileW, y = row * kTileH;
  return {x, y, std::min(kTileW, s.width - x), std::min(kTileH, s.height - y)};
}

void start_transmittance(const TileArea& area, float* t) {
  std::fill(t, t + kPixels, 0.0f);
  for (int y = 0; y < area.h; ++y)
    for (int x = 0; x < area.w; ++x) t[pixel_at(x, y)] = 1.0f;
}

bool finished(const float* t) {
  Vec most = splat(0.0f);
  for (int i = 0; i < kPixels; i += kLanes) {
    const Vec v = load(t + i);
    most = v > most ? v : most;
  }
  float lanes[kLanes];
  store(lanes, most);
  return *std::max_element(lanes, lanes + kLanes) <= 0.0f;
}

// A Gaussian along one window of columns.
struct Window {
  Vec dx, q0, q1;

  template <int NC>
  SX_INLINE Window(const Record<NC>& g, int x)
      : dx(column_of_lane() + (static_cast<float>(x) + 0.5f - g.u)), q0(dx * dx * g.qa), q1(dx * g.qb) {}
};

// The part of a Gaussian's box inside a tile, in tile pixels; its first row is one that a window may start at.
struct Box {
  int x0, x1, y0, y1;

  template <int NC>
  SX_INLINE Box(const Record<NC>& g, const TileArea& a)
      : x0(std::max(g.x0 - a.x, 0)),
        x1(std::min(g.x1 - a.x, kTileW)),
        y0(std::max(g.y0 - a.y, 0) / kRows * kRows),
        y1(std::min(g.y1 - a.y, kTileH)) {}
};

template <int NC>
SX_INLINE Vec first_dy(const Record<NC>& g, const TileArea& a, const Box& box) {
  return row_of_lane() + (static_cast<float>(a.y + box.y0) + 0.5f - g.v);
}

// Uncapped alpha of a window, 0 where the pair is skipped. Both passes must take the same decisions: one function.
template <int NC>
SX_INLINE Vec alpha_of(const Record<NC>& g, const Window& window, Vec dy) {
  const Vec power = window.q0 + dy * (window.q1 + g.qc * dy);
  const Vec exponent = power + g.level;
  const Mask seen = (power <= 0.0f) & (exponent >= -7.99435343685886f);  // log2(1/255)
  return keep(seen, exp2_vec(exponent));
}

template <int NC>
void blend_tile(const SxScene& s, const Record<NC>* records, const uint32_t* entries, size_t n, const TileArea& area,
                float* planes, float* transmittance) {
  alignas(64) float t[kPixels];
  alignas(64) float colour[NC][kPixels];
  start_transmittance(area, t);
  std::memset(colour, 0, sizeof colour);
  for (size_t i = 0; i < n; ++i) {
    if (i % kDoneEvery == 0 && i > 0 && finished(t)) break;
    if (i + kAhead < n) __builtin_prefetch(&records[entries[i + kAhead]]);
    const Record<NC>& g = records[entries[i]];
    const Box box(g, area);
    for (int x = box.x0; x < box.x1; x += kColumns) {
      const Window window(g, area.x + x);
      Vec dy = first_dy(g, area, box);
      for (int y = box.y0; y < box.y1; y += kRows, dy += static_cast<float>(kRows)) {
        const int at = pixel_at(x, y);
        Vec alpha = alpha_of(g, window, dy);
        alpha = alpha < s.max_alpha ? alpha : splat(s.max_alpha);
        const Vec before = load(t + at);
        const Vec after = before * (1.0f - alpha);
        const Mask going = after > kMinTransmittance;
        const Vec weight = keep(going, before * alpha);
        const Vec stopped = (Vec)((Mask)before | std::numeric_limits<int32_t>::min());
        store(t + at, going ? after : stopped);
        for (int c = 0; c < NC; ++c) store(&colour[c][at], load(&colour[c][at]) + weight * g.feature[c]);
      }
    }
  }
  const int64_t plane = static_cast<int64_t>(s.width) * s.height;
  for (int y = 0; y < area.h; ++y) {
    const int64_t to = static_cast<int64_t>(area.y + y) * s.width + area.x;
    for (int x = 0; x < area.w; ++x) transmittance[to + x] = std::abs(t[pixel_at(x, y)]);
    for (int c = 0; c < std::min(NC, channels_of(s)); ++c)
      for (int x = 0; x < area.w; ++x) planes[c * plane + to + x] = colour[c][pixel_at(x, y)];
  }
}

template <int NC>
View* forward(const SxScene& s, float* planes, float* transmittance, float* radii) {
  Team team(threads_for(s));
  auto view = std::make_unique<ViewOf<NC>>();
  view->count = s.count;
  view->channels = NC;
  view->tiles_x = (s.width + kTileW - 1) / kTileW, view->tiles_y = (s.height + kTileH - 1) / kTileH;
  view->records = uninitialised<Record<NC>>(s.count);
  view->rects = uninitialised<Rect>(s.count);
  {
    DepthKeys keys;
    project_all<NC>(s, team, Camera(s), *view, keys, radii);
    order_by_depth(team, keys, *view);
  }
  choose_bands(s, *view);
  for (size_t band = 0; band + 1 < view->bands.size(); ++band) {
    const int row0 = view->bands[band], row1 = view->bands[band + 1];
    fill_bins(*view, team, row0, row1, view->bins);
    const Bins& bins = view->bins;
    team.run(static_cast<int64_t>(row1 - row0) * view->tiles_x, [&](int64_t tile) {
      const TileArea area =
          tile_area(s, static_cast<int>(tile % view->tiles_x), row0 + static_cast<int>(tile / view->tiles_x));
      blend_tile<NC>(s, view->records.get(), bins.entries.get() + bins.start[tile],
                     bins.start[tile + 1] - bins.start[tile], area, planes, transmittance);
    });
  }
  if (view->bands.size() > 2) view->bins = Bins();
  return view.release();
}

// ------------------------------------------------------------------------------------------------ backward

// Loads one tile of an image plane into padded tile rows.
void load_tile(const float* plane, int width, const TileArea& area, float* tile) {
  std::fill(tile, tile + kPixels, 0.0f);
  for (int y = 0; y < area.h; ++y) {
    const float* row = plane + static_cast<int64_t>(area.y + y) * width + area.x;
    for (int x = 0; x < area.w; ++x) tile[pixel_at(x, y)] = row[x];
  }
}

struct Upstream {  // images and the loss's gradients with respect to them
  const float *planes, *transmittance, *d_planes, *d_alpha;
};

// With w = T alpha and S = sum of w (c . dC) over the Gaussians behind - dA T_final:
//   dL/dalpha = T (c . dC) - S / (1 - alpha);  S starts as C . dC - dA T_final and loses each Gaussian as it passes.
// A slot receives the six moments of v = alpha dL/dalpha over the pixels, then dL/dfeature.
template <int NC, class SlotOf, class Fetch>
void blend_tile_backward(const SxScene& s, const Record<NC>* records, const uint32_t* entries, size_t n,
                         const TileArea& area, const Upstream& up, const SlotOf& slot_of, const Fetch& fetch) {
  alignas(64) float t[kPixels], rest[kPixels];
  alignas(64) float d_colour[NC][kPixels];
  alignas(64) float scratch[kPixels];
  const int64_t plane = static_cast<int64_t>(s.width) * s.height;
  start_transmittance(area, t);
  load_tile(up.transmittance, s.width, area, rest);
  load_tile(up.d_alpha, s.width, area, scratch);
  for (int i = 0; i < kPixels; ++i) rest[i] *= -scratch[i];
  for (int c = 0; c < NC; ++c) {
    if (c >= channels_of(s)) {
      std::memset(d_colour[c], 0, sizeof d_colour[c]);
      continue;
    }
    load_tile(up.planes + c * plane, s.width, area, scratch);
    load_tile(up.d_planes + c * plane, s.width, area, d_colour[c]);
    for (int i = 0; i < kPixels; ++i) rest[i] += scratch[i] * d_colour[c][i];
  }
  size_t i = 0;
  for (; i < n; ++i) {
    if (i % kDoneEvery == 0 && i > 0 && finished(t)) break;
    if (i + 2 * kAhead < n) fetch(entries[i + 2 * kAhead]);
    if (i + kAhead < n) __builtin_prefetch(slot_of(entries[i + kAhead]), 1);
    const Record<NC>& g = records[entries[i]];
    const Box box(g, area);
    Vec moments[kMoments] = {}, d_feature[NC] = {};
    for (int x = box.x0; x < box.x1; x += kColumns) {
      const Window window(g, area.x + x);
      Vec m0{}, m1{}, m2{}, dy = first_dy(g, area, box);
      for (int y = box.y0; y < box.y1; y += kRows, dy += static_cast<float>(kRows)) {
        const int at = pixel_at(x, y);
        const Vec raw = alpha_of(g, window, dy);
        const Mask free = raw < s.max_alpha;
        Vec alpha = free ? raw : splat(s.max_alpha);
        const Vec before = load(t + at);
        const Vec after = before * (1.0f - alpha);
        const Mask going = after > kMinTransmittance;
        const Vec stopped = (Vec)((Mask)before | std::numeric_limits<int32_t>::min());
        store(t + at, going ? after : stopped);
        alpha = keep(going, alpha);
        const Vec weight = before * alpha;
        Vec along{};
        for (int c = 0; c < NC; ++c) {
          const Vec d = load(&d_colour[c][at]);
          along += d * g.feature[c];
          d_feature[c] += d * weight;
        }
        const Vec own = weight * along;
        const Vec behind = load(rest + at) - own;
        store(rest + at, behind);
        const Vec v = keep(free, own - behind * (alpha / (1.0f - alpha)));
        const Vec v_dy = v * dy;
        m0 += v, m1 += v_dy, m2 += v_dy * dy;
      }
      const Vec m0_dx = m0 * window.dx;
      moments[0] += m0, moments[1] += m0_dx, moments[2] += m1;
      moments[3] += m0_dx * window.dx, moments[4] += m1 * window.dx, moments[5] += m2;
    }
    Vec all[kMoments + NC];
    std::copy(moments, moments + kMoments, all);
    std::copy(d_feature, d_feature + NC, all + kMoments);
    lane_sums<kMoments + NC>(all, slot_of(entries[i]));
  }
  for (; i < n; ++i) std::memset(slot_of(entries[i]), 0, sizeof(float) * (kMoments + NC));
}

// Adds dL/d(view matrix) of one chunk of Gaussians; double, because it sums over the whole scene.
struct CameraSums {
  double r[9] = {}, t[3] = {};
};

SX_INLINE void quat_backward(const Projection& o, const Vec* d, Vec* out) {  // d: dL/d(rotation matrix)
  const Vec w = o.q[0], x = o.q[1], y = o.q[2], z = o.q[3];
  const Vec dq[4] = {
      2.0f * (x * (d[7] - d[5]) + y * (d[2] - d[6]) + z * (d[3] - d[1])),
      2.0f * (w * (d[7] - d[5]) + y * (d[1] + d[3]) + z * (d[2] + d[6]) - 2.0f * x * (d[4] + d[8])),
      2.0f * (w * (d[2] - d[6]) + x * (d[1] + d[3]) + z * (d[5] + d[7]) - 2.0f * y * (d[0] + d[8])),
      2.0f * (w * (d[3] - d[1]) + x * (d[2] + d[6]) + y * (d[5] + d[7]) - 2.0f * z * (d[0] + d[4])),
  };
  const Vec along = dq[0] * w + dq[1] * x + dq[2] * y + dq[3] * z;  // the length of a quaternion has no effect
  for (int i = 0; i < 4; ++i) out[i] = (dq[i] - along * o.q[i]) * o.inv_norm;
}

// dL/dmean (world) and dL/d(camera position) are opposite: returns the former.
void shade_backward(const SxScene& s, const Camera& cam, int64_t g, const float* colour, const float* d_rgb,
                    float* d_colours, float* d_mean) {
  const int n = s.sh_coefficients;
  if (n == 0) {
    for (int c = 0; c < 3; ++c) d_colours[3 * g + c] += d_rgb[c];
    return;
  }
  float basis[16], weight[16], d_dir[3];
  const Direction dir = view_direction(s, cam, g);
  sh_basis(n, dir.d[0], dir.d[1], dir.d[2], basis);
  const float* sh = s.colours + static_cast<int64_t>(3) * n * g;
  float* d_sh = d_colours + static_cast<int64_t>(3) * n * g;
  float d[3];
  for (int c = 0; c < 3; ++c) d[c] = colour[c] > 0.0f ? d_rgb[c] : 0.0f;
  for (int k = 0; k < n; ++k) {
    weight[k] = sh[3 * k] * d[0] + sh[3 * k + 1] * d[1] + sh[3 * k + 2] * d[2];
    for (int c = 0; c < 3; ++c) d_sh[3 * k + c] += basis[k] * d[c];
  }
  sh_gradient(n, dir.d[0], dir.d[1], dir.d[2], weight, d_dir);
  const float along = dot3(d_dir, dir.d);
  for (int i = 0; i < 3; ++i) d_mean[i] = (d_dir[i] - along * dir.d[i]) * dir.inv_length;
}

void clear_gradients(const SxScene& s, const SxGradients& grad, int64_t chunk) {
  const int64_t first = chunk * kChunk, rows = std::min<int64_t>(s.count - first, kChunk);
  auto clear = [&](float* all, int64_t width) {
    if (all) std::fill_n(all + first * width, rows * width, 0.0f);
  };
  clear(grad.extras, s.extra_channels), clear(grad.offsets, 2);
  if (grad.add) return;
  clear(grad.means, 3), clear(grad.quats, 4), clear(grad.scales, 3), clear(grad.opacities, 1);
  clear(grad.colours, 3 * std::max(1, s.sh_coefficients));
}

// Carries the summed slots of the up to kLanes Gaussians from g on through their projection.
template <int NC>
void project_backward(const SxScene& s, const Camera& cam, const ViewOf<NC>& view, int64_t g,
                      const float (*slots)[kMoments + NC], const SxGradients& grad, CameraSums& cam_sums) {
  const int n = static_cast<int>(std::min<int64_t>(s.count - g, kLanes));
  const Rect* rects = view.rects.get() + g;
  Projection o;
  if (!any(project(s, cam, g, o))) return;
  Vec sums[kMoments + NC];
  load_rows<kMoments + NC>(slots[0], n, sums);
  // Conic (a, b, c) of the blurred covariance, and the mean: sigma = a dx^2 / 2 + b dx dy + c dy^2 / 2, d = pixel - mean.
  const Vec a = o.by / o.det1, b = -o.xy / o.det1, c = o.bx / o.det1;
  const Vec d_u = a * sums[1] + b * sums[2], d_v = b * sums[1] + c * sums[2];
  const Vec da = -0.5f * sums[3], half_db = -0.5f * sums[4], dc = -0.5f * sums[5];
  // d(covariance) = -Q dQ Q.
  const Vec h00 = a * da + b * half_db, h01 = a * half_db + b * dc;
  const Vec h10 = b * da + c * half_db, h11 = b * half_db + c * dc;
  Vec d_xx = -(h00 * a + h01 * b), d_xy = -2.0f * (h00 * b + h01 * c), d_yy = -(h10 * b + h11 * c);
  const Vec d_compensated = sums[0] / o.opacity;
  const Vec d_opacity = d_compensated * o.compensation;
  if (s.antialiased) {
    const Vec d_ratio = keep(o.compensation > kMinCompensation, d_compensated * o.given_opacity * 0.5f / o.compensation);
    const Vec d_det0 = d_ratio / o.det1, d_det1 = -d_ratio * o.det0 / (o.det1 * o.det1);
    d_xx += d_det0 * o.yy + d_det1 * o.by, d_yy += d_det0 * o.xx + d_det1 * o.bx;
    d_xy -= 2.0f * o.xy * (d_det0 + d_det1);
  }
  Vec d_a[9], d_j00{}, d_j02{}, d_j11{}, d_j12{};
  for (int j = 0; j < 3; ++j) {
    const Vec d_v0 = 2.0f * d_xx * o.v0[j] + d_xy * o.v1[j], d_v1 = d_xy * o.v0[j] + 2.0f * d_yy * o.v1[j];
    d_a[j] = o.j00 * d_v0, d_a[3 + j] = o.j11 * d_v1, d_a[6 + j] = o.j02 * d_v0 + o.j12 * d_v1;
    d_j00 += o.a[j] * d_v0, d_j02 += o.a[6 + j] * d_v0;
    d_j11 += o.a[3 + j] * d_v1, d_j12 += o.a[6 + j] * d_v1;
  }
  const Vec iz = o.inv_z;
  Vec d_p[3] = {d_u * o.j00, d_v * o.j11, -(d_u * o.j00 * o.p[0] + d_v * o.j11 * o.p[1]) * iz};
  d_p[2] -= iz * (d_j00 * o.j00 + d_j02 * o.j02 + d_j11 * o.j11 + d_j12 * o.j12);
  d_p[0] -= keep(o.x_free, d_j02 * o.j00 * iz), d_p[2] += keep(o.x_free, d_j02 * o.j00 * o.rx * iz);
  d_p[1] -= keep(o.y_free, d_j12 * o.j11 * iz), d_p[2] += keep(o.y_free, d_j12 * o.j11 * o.ry * iz);
  if constexpr (NC > 3)
    if (s.with_depth) d_p[2] += sums[kMoments + 3];

  Vec d_rot[9], d_scale[3] = {}, d_quat[4];
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      const Vec d_m = cam.r[i] * d_a[j] + cam.r[3 + i] * d_a[3 + j] + cam.r[6 + i] * d_a[6 + j];
      d_scale[j] += o.rot[3 * i + j] * d_m;
      d_rot[3 * i + j] = d_m * o.scale[j];
    }
  quat_backward(o, d_rot, d_quat);

  Vec d_seen[3] = {};  // dL/dmean through the viewing direction
  for (int lane = 0; lane < n; ++lane) {
    if (!is_seen(rects[lane])) continue;
    float d[3] = {};
    shade_backward(s, cam, g + lane, view.records[g + lane].feature, slots[lane] + kMoments, grad.colours, d);
    for (int i = 0; i < 3; ++i) d_seen[i][lane] = d[i];
  }
  Vec d_mean[3], d_t[3], d_r[9];
  for (int i = 0; i < 3; ++i) {
    d_mean[i] = cam.r[i] * d_p[0] + cam.r[3 + i] * d_p[1] + cam.r[6 + i] * d_p[2] + d_seen[i];
    d_t[i] = d_p[i] + dot3(cam.r + 3 * i, d_seen);  // camera position = -R^T t moves against the mean
    for (int j = 0; j < 3; ++j) {
      d_r[3 * i + j] = d_p[i] * o.m[j] + cam.t[i] * d_seen[j];
      for (int k = 0; k < 3; ++k) d_r[3 * i + j] += d_a[3 * i + k] * o.scale[k] * o.rot[3 * j + k];
    }
  }

  for (int lane = 0; lane < n; ++lane) {
    if (!is_seen(rects[lane])) continue;
    const int64_t at = g + lane;
    const float* extras = slots[lane] + kMoments + 3 + s.with_depth;
    for (int i = 0; i < 3; ++i) grad.means[3 * at + i] += d_mean[i][lane], grad.scales[3 * at + i] += d_scale[i][lane];
    for (int i = 0; i < 4; ++i) grad.quats[4 * at + i] += d_quat[i][lane];
    grad.opacities[at] += d_opacity[lane];
    if (grad.offsets) grad.offsets[2 * at] += d_u[lane], grad.offsets[2 * at + 1] += d_v[lane];
    if (grad.extras)
      for (int e = 0; e < s.extra_channels; ++e) grad.extras[at * s.extra_channels + e] += extras[e];
    for (int i = 0; i < 9; ++i) cam_sums.r[i] += d_r[i][lane];
    for (int i = 0; i < 3; ++i) cam_sums.t[i] += d_t[i][lane];
  }
}

template <int NC>
void backward(const SxScene& s, View& base, const Upstream& up, const SxGradients& grad) {
  constexpr int kSlot = kMoments + NC;
  Team team(threads_for(s));
  auto& view = static_cast<ViewOf<NC>&>(base);
  const bool banded = view.bands.size() > 2;
  const int64_t chunks = chunks_of(s.count);
  std::vector<float> carried(banded ? s.count * kSlot : 0, 0.0f);  // sums of the bands so far
  auto offset = uninitialised<uint64_t>(s.count);                  // of a Gaussian's slots from its chunk's first
  std::vector<uint64_t> chunk_offset(chunks);
  Buffer<float> slots;
  auto first_slot = [&](int64_t g) { return slots.get() + (chunk_offset[g / kChunk] + offset[g]) * kSlot; };
  auto add_slots = [&](int64_t g, int row0, int row1, float* sums) {
    const float* slot = first_slot(g);
    for (int64_t n = tiles_in(view.rects[g], row0, row1); n > 0; --n, slot += kSlot)
      for (int k = 0; k < kSlot; ++k) sums[k] += slot[k];
  };

  for (size_t band = 0; band + 1 < view.bands.size(); ++band) {
    const int row0 = view.bands[band], row1 = view.bands[band + 1];
    Bins refilled;
    if (banded) fill_bins(view, team, row0, row1, refilled);
    const Bins& bins = banded ? refilled : view.bins;
    team.run(chunks, [&](int64_t chunk) {
      uint64_t in_chunk = 0;
      each_of_chunk(chunk, s.count, [&](int64_t g) {
        offset[g] = in_chunk;
        in_chunk += tiles_in(view.rects[g], row0, row1);
      });
      chunk_offset[chunk] = in_chunk;
    });
    uint64_t total = 0;
    for (uint64_t& in_chunk : chunk_offset) total += std::exchange(in_chunk, total);
    slots = uninitialised<float>(total * kSlot);
    team.run(static_cast<int64_t>(row1 - row0) * view.tiles_x, [&](int64_t tile) {
      const int column = static_cast<int>(tile % view.tiles_x), row = row0 + static_cast<int>(tile / view.tiles_x);
      auto fetch = [&](uint32_t g) {
        __builtin_prefetch(&view.records[g]), __builtin_prefetch(&view.rects[g]), __builtin_prefetch(&offset[g]);
      };
      auto slot_of = [&](uint32_t g) {
        const Rect& r = view.rects[g];
        const uint64_t within = static_cast<uint64_t>(row - std::max<int>(r.y0, row0)) * (r.x1 - r.x0) + column - r.x0;
        return first_slot(g) + within * kSlot;
      };
      blend_tile_backward<NC>(s, view.records.get(), bins.entries.get() + bins.start[tile],
                              bins.start[tile + 1] - bins.start[tile], tile_area(s, column, row), up, slot_of, fetch);
    });
    if (!banded) break;
    team.run(chunks, [&](int64_t chunk) {
      each_of_chunk(chunk, s.count, [&](int64_t g) { add_slots(g, row0, row1, carried.data() + g * kSlot); });
    });
  }

  const Camera cam(s);
  std::vector<CameraSums> cam_sums(chunks);
  team.run(chunks, [&](int64_t chunk) {
    clear_gradients(s, grad, chunk);  // here rather than all at once: every thread, and rows that stay in its cache
    const int64_t end = std::min<int64_t>(s.count, (chunk + 1) * kChunk);
    for (int64_t g = chunk * kChunk; g < end; g += kLanes) {
      float sums[kLanes][kSlot] = {};
      const int64_t n = std::min<int64_t>(end - g, kLanes);
      if (banded)
        std::copy_n(carried.data() + g * kSlot, n * kSlot, sums[0]);
      else
        for (int64_t lane = 0; lane < n; ++lane) add_slots(g + lane, 0, view.tiles_y, sums[lane]);
      project_backward<NC>(s, cam, view, g, sums, grad, cam_sums[chunk]);
    }
  });
  std::fill_n(grad.cam_from_world, 16, 0.0f);
  CameraSums total;
  for (const CameraSums& part : cam_sums) {
    for (int i = 0; i < 9; ++i) total.r[i] += part.r[i];
    for (int i = 0; i < 3; ++i) total.t[i] += part.t[i];
  }
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) grad.cam_from_world[4 * i + j] += static_cast<float>(total.r[3 * i + j]);
    grad.cam_from_world[4 * i + 3] += static_cast<float>(total.t[i]);
  }
}

// Channel counts are compile-time constants of the inner loops; others are padded with zero channels.
template <class Fn>
auto with_channels(int channels, const Fn& fn) {
  if (channels <= 3) return fn(std::integral_constant<int, 3>());
  if (channels <= 4) return fn(std::integral_constant<int, 4>());
  if (channels <= 5) return fn(std::integral_constant<int, 5>());
  if (channels <= 8) return fn(std::integral_constant<int, 8>());
  return fn(std::integral_constant<int, 16>());
}

}  // namespace

// ------------------------------------------------------------------------------------------------ entry points

SX_API int32_t sx_abi_version() { return 2; }
SX_API const char* sx_source_hash() { return SX_SOURCE_HASH; }  // of this file and the compiler's flags, see recipe.py
SX_API int32_t sx_max_channels() { return 16; }

// Renders planes [channels,H,W], transmittance [H,W] and radii [N] (pixels, 0: not seen). Returns the view's state for
// sx_backward, to be released by sx_free, or null if memory ran out.
SX_API void* sx_forward(const SxScene* scene, float* planes, float* transmittance, float* radii) {
  try {
    return with_channels(channels_of(*scene),
                         [&](auto nc) { return forward<decltype(nc)::value>(*scene, planes, transmittance, radii); });
  } catch (const std::exception&) {
    return nullptr;
  }
}

// Writes `gradients`, given the outputs of sx_forward for the same scene and the loss's gradients. 0, or 1 if memory ran out.
SX_API int32_t sx_backward(const SxScene* scene, void* state, const float* planes, const float* transmittance,
                           const float* d_planes, const float* d_alpha, const SxGradients* gradients) {
  try {
    const Upstream up{planes, transmittance, d_planes, d_alpha};
    View& view = *static_cast<View*>(state);
    with_channels(channels_of(*scene),
                  [&](auto nc) { return backward<decltype(nc)::value>(*scene, view, up, *gradients); });
    return 0;
  } catch (const std::exception&) {
    return 1;
  }
}

SX_API void sx_free(void* state) { delete static_cast<View*>(state); }
