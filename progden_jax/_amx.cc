// Convolutions by the matrix units of x86 CPUs (AMX), for XLA's foreign function interface.
//
// These multiply 16x32 by 32x16 bfloat16 and sum in float32. A float32 is the sum of three bfloat16, and of
// the nine products of two such sums six matter: with those the result is as good as of float32 products.
//
// An image's pixels are rows of a matrix as they lie in memory: a row of taps, kw * c values one after
// another, begins c values after its neighbour's. So nothing is gathered but what is rounded, patch by patch.
//
// Down the columns a kernel's taps are the coefficients of a polynomial. R rows of outputs from T taps take
// R + T - 1 products of lines, each a sum of rows, where there were R * T (Toom and Cook).

#include <immintrin.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <memory>
#include <mutex>
#include <new>
#include <utility>
#include <vector>

#include "xla/ffi/api/ffi.h"

namespace ffi = xla::ffi;

namespace {

using Half = uint16_t;  // bfloat16

constexpr int64_t kTile = 16;       // rows of a tile, and float32 in one of its rows
constexpr int64_t kDepth = 32;      // bfloat16 in one of its rows
constexpr int64_t kHalves = 512;    // bfloat16 in a tile
constexpr int64_t kPixels = 32;     // of a block, by as many outputs: four tiles of sums. Or twice by half as many
constexpr int64_t kSums = 4 * kTile * kTile + kTile;  // of a line of a block; all 4 KiB apart would evict each other
constexpr int64_t kPatch = 1 << 19; // bytes that what is gathered may take, of a second-level cache's 2 MiB

struct Free {
  void operator()(void* memory) const { std::free(memory); }
};

struct Memory {
  std::unique_ptr<char, Free> data;
  int64_t size = 0;

  template <typename T>
  T* reserve(int64_t count) {
    const int64_t bytes = (count * sizeof(T) + 63) / 64 * 64;
    if (bytes > size) {
      data.reset(static_cast<char*>(std::aligned_alloc(64, bytes)));
      if (!data) throw std::bad_alloc();
      size = bytes;
    }
    return reinterpret_cast<T*>(data.get());
  }
};

struct alignas(64) Palette {
  uint8_t id = 1, start = 0, rest[14] = {};
  uint16_t bytes[16] = {64, 64, 64, 64, 64, 64, 64, 64};
  uint8_t rows[16] = {16, 16, 16, 16, 16, 16, 16, 16};
};

inline __mmask16 first(int64_t count) { return count >= 16 ? 0xffff : (1u << std::max<int64_t>(count, 0)) - 1; }

inline __m512 widened(__m256i halves) {
  return _mm512_castsi512_ps(_mm512_slli_epi32(_mm512_cvtepu16_epi32(halves), 16));
}

// What rounding left of x; of infinities nothing.
inline __m512 rest(__m512 x, __m512 rounded) {
  return _mm512_maskz_sub_ps(_mm512_cmp_ps_mask(x, rounded, _CMP_NEQ_OQ), x, rounded);
}

template <int P>
inline void split(__m512 x, __m256i (&parts)[P]) {
  for (int p = 0; p < P; ++p) {
    parts[p] = (__m256i)_mm512_cvtneps_pbh(x);
    if (p + 1 < P) x = rest(x, widened(parts[p]));
  }
}

// R rows of outputs from lines, which are sums of rows of the image, and kernels of lines, sums of rows of taps:
// out * ((taps * kernel) x (in * image)). At infinity and the finite points that `_points.py` found to round least.
template <int R_, int T_>
struct Toom {
  static constexpr int R = R_, T = T_, Q = R + T - 1;
  static constexpr bool kSummed = false;  // Each line has sums of its own.
  bool mirrored[Q] = {};                  // Where the next point is the negative of this one.
  float in[Q][Q] = {}, taps[Q][T] = {}, out[R][Q] = {};

  constexpr explicit Toom(const double (&points)[Q - 1]) {
    for (int q = 0; q < Q; ++q) {
      const bool finite = q < Q - 1;
      double product[Q] = {1}, scale = 1;  // of x minus each other finite point, lowest power first
      for (int k = 0, degree = 0; k < Q - 1; ++k) {
        if (k == q) continue;
        for (int j = ++degree; j >= 0; --j) product[j] = (j ? product[j - 1] : 0) - points[k] * product[j];
        if (finite) scale *= points[q] - points[k];
      }
      for (int j = 0; j < Q; ++j) in[q][j] = static_cast<float>(product[j]);
      mirrored[q] = q + 1 < Q - 1 && points[q] > 0 && points[q + 1] == -points[q];
      double power = 1;
      for (int j = 0; j < Q; ++j) {
        if (j < T) taps[q][j] = static_cast<float>(finite ? power / scale : j == T - 1);
        if (j < R) out[j][q] = static_cast<float>(finite ? power : j == R - 1);
        if (finite) power *= points[q];
      }
    }
  }
};

constexpr double kThree[] = {0, 1}, kFour[] = {0, 1, -1}, kFive[] = {0, 1, -2, -0.5};
constexpr double kSix[] = {0, 1.5, -1.5, 2. / 3, -2. / 3};
struct Toom43 : Toom<4, 3> { constexpr Toom43() : Toom(kSix) {} };
struct Toom25 : Toom<2, 5> { constexpr Toom25() : Toom(kSix) {} };
struct Toom23 : Toom<2, 3> { constexpr Toom23() : Toom(kFour) {} };
struct Toom42 : Toom<4, 2> { constexpr Toom42() : Toom(kFive) {} };
struct Toom22 : Toom<2, 2> { constexpr Toom22() : Toom(kThree) {} };

// Row by row, for any kernel: lines are rows, and what belongs to one row of outputs is summed.
struct Direct {
  static constexpr int R = 1, T = 0, Q = 1;
  static constexpr bool kSummed = true;
  bool mirrored[1] = {};
  float in[1][1] = {{1}}, out[1][1] = {{1}};
};

// What a constant times x adds to a sum of which nothing is there before the first term.
template <class W, bool Begun>
inline __m512 plus(__m512 sum, __m512 x) {
  constexpr float weight = W::value();
  if constexpr (weight == 0) return sum;
  else if constexpr (weight == 1) return Begun ? _mm512_add_ps(sum, x) : x;
  else return Begun ? _mm512_fmadd_ps(_mm512_set1_ps(weight), x, sum) : _mm512_mul_ps(_mm512_set1_ps(weight), x);
}

template <class S, int q, int j>
struct Of {
  static constexpr float value() { return S{}.in[q][j]; }
};

template <class S, int r, int q>
struct To {
  static constexpr float value() { return S{}.out[r][q]; }
};

// Of line q the rows from j on, each `Step` further.
template <class S, int q, int j, int Step, bool Begun = false>
inline __m512 summed(const __m512 (&rows)[S::Q], __m512 sum = _mm512_setzero_ps()) {
  if constexpr (j >= S::Q) return sum;
  else {
    using W = Of<S, q, j>;
    return summed<S, q, j + Step, Step, Begun || W::value() != 0>(rows, plus<W, Begun>(sum, rows[j]));
  }
}

// Points p and -p share what even rows add up to, and what odd ones do.
template <class S, int q = 0>
inline void to_lines(const __m512 (&rows)[S::Q], __m512 (&lines)[S::Q]) {
  if constexpr (q < S::Q) {
    if constexpr (S{}.mirrored[q]) {
      const __m512 even = summed<S, q, 0, 2>(rows), odd = summed<S, q, 1, 2>(rows);
      lines[q] = _mm512_add_ps(even, odd);
      lines[q + 1] = _mm512_sub_ps(even, odd);
      to_lines<S, q + 2>(rows, lines);
    } else {
      lines[q] = summed<S, q, 0, 1>(rows);
      to_lines<S, q + 1>(rows, lines);
    }
  }
}

// Lines of p and -p become their sum, for even rows, and their difference, for odd ones.
template <class S, int q = 0>
inline void fold(__m512 (&lines)[S::Q]) {
  if constexpr (q < S::Q) {
    if constexpr (S{}.mirrored[q]) {
      const __m512 first = lines[q];
      lines[q] = _mm512_add_ps(first, lines[q + 1]);
      lines[q + 1] = _mm512_sub_ps(first, lines[q + 1]);
    }
    fold<S, q + 1>(lines);
  }
}

template <class S, int r, int q = 0, bool Begun = false>
inline __m512 row(const __m512 (&folded)[S::Q], __m512 sum = _mm512_setzero_ps()) {
  if constexpr (q >= S::Q) return sum;
  else {
    constexpr bool mirrored = S{}.mirrored[q];
    using W = To<S, r, q>;
    const __m512 next = plus<W, Begun>(sum, folded[q + (mirrored && r % 2)]);
    return row<S, r, q + 1 + mirrored, Begun || W::value() != 0>(folded, next);
  }
}

template <class S, int r = 0>
inline void to_rows(const __m512 (&folded)[S::Q], __m512 (&rows)[S::R]) {
  if constexpr (r < S::R) {
    rows[r] = row<S, r>(folded);
    to_rows<S, r + 1>(folded, rows);
  }
}

struct Source {
  const float* image;   // n, h, w, c
  int64_t h, w, c;
  const float* kernel;  // kh, kw, c, outputs
  int64_t kh, kw;
  // At half the output's size, with the four pixels over each cell of it as outputs: a 2x2 kernel whose
  // window begins one row and column before the cell for those above and left, at the cell for the others.
  bool corners;
};

// Rows of a source's taps that lie as far apart as rows of cells do.
struct Part {
  Source of;
  int64_t every, offset;      // Cells at y, of parity i, begin at the source's row y * every + offset + i.
  std::vector<int64_t> taps;  // rows of the kernel
  Memory memory = {};
  Half* packed = nullptr;     // [parity][16 outputs][line][tap][step][plane] tiles
  // Multiples of 16 channels: taps have steps of their own, and two values 16 channels apart share 32 bits. Of 16
  // channels that would fill half a step two planes do, which gives two products.
  bool woven = false, half = false;
  int64_t across = 1, steps = 0, size = 0;  // taps with steps of their own; full steps; halves of a line

  template <int P>
  void plan() {
    woven = P == 3 && of.c % kTile == 0;
    half = woven && of.c % kDepth;
    across = woven ? of.kw : 1;
    steps = woven ? of.c / kDepth : (of.kw * of.c + kDepth - 1) / kDepth;
    size = all_steps() * P * kHalves;
  }

  // Of a line, full and half ones.
  int64_t all_steps() const { return across * (steps + half); }

  template <class S>
  int64_t lines() const { return S::kSummed ? taps.size() : S::Q; }
};

struct Job {
  std::vector<Part> parts;
  const float* bias = nullptr;      // outputs
  const float* plus = nullptr;      // n, H, W, outputs: added
  const uint8_t* gate = nullptr;    // n, H / bits, W, outputs: where values pass, a bit for each of `bits` rows
  const uint8_t* inside = nullptr;  // images, H, W: zero elsewhere
  int64_t bits = 1, images = 1;
  bool relu = false;
  float* out = nullptr;             // n, H, W, outputs
  int64_t n, H, W, outputs;
  int64_t step = 1;                 // 2 where a source has corners: even and odd pixels have taps of their own
  int64_t rows = 0, columns = 0;    // of a task, in cells of step by step pixels

  int64_t tiles() const { return (outputs + kTile - 1) / kTile; }

  // Rows that are gathered at a time.
  template <class S>
  int64_t height() const { return S::kSummed ? rows : S::R; }
};

struct Patch {
  Half* data;
  int64_t x, row, plane;     // its first column; halves from line to line and plane to plane,
  int64_t pixel, step;       // pixel to pixel and step to step
};

// Of one line: outputs from that tile on, for a pair of inputs one after the other.
template <int P, class S>
void pack_line(const Job& job, const Part& part, int64_t parity, int64_t t, int64_t line, Half* to) {
  static constexpr S scheme{};
  const Source& s = part.of;
  const int64_t depth = s.kw * s.c, stride = (s.corners ? 4 : 1) * job.outputs;
  const __mmask16 mask = first(job.outputs - t * kTile);
  const float* from = s.kernel + (s.corners ? parity : 0) * job.outputs + t * kTile;
  auto value = [&](int64_t k) {
    auto tap = [&](int64_t n) { return _mm512_maskz_loadu_ps(mask, from + (part.taps[n] * depth + k) * stride); };
    if (k >= depth) return _mm512_setzero_ps();
    if constexpr (S::kSummed) {
      return tap(line);
    } else {
      __m512 sum = _mm512_setzero_ps();
      for (size_t n = 0; n < part.taps.size(); ++n)
        sum = _mm512_fmadd_ps(_mm512_set1_ps(scheme.taps[line][n]), tap(n), sum);
      return sum;
    }
  };
  auto both = [](__m256i low, __m256i high) {
    return _mm512_or_si512(_mm512_slli_epi32(_mm512_cvtepu16_epi32(high), 16), _mm512_cvtepu16_epi32(low));
  };
  int64_t k = 0;
  for (int64_t tap = 0; tap < part.across; ++tap) {
    for (int64_t step = 0; step < part.steps; ++step, k += kDepth, to += P * kHalves)
      for (int64_t row = 0; row < kTile; ++row) {
        __m256i low[P], high[P];
        split<P>(value(part.woven ? k + row : k + 2 * row), low);
        split<P>(value(part.woven ? k + row + kTile : k + 2 * row + 1), high);
        for (int p = 0; p < P; ++p) _mm512_store_si512(to + p * kHalves + row * kDepth, both(low[p], high[p]));
      }
    if (!part.half) continue;
    for (int64_t row = 0; row < kTile; ++row, ++k, to += kDepth) {
      __m256i planes[3];
      split<3>(value(k), planes);
      _mm512_store_si512(to, both(planes[2], planes[0]));
      _mm512_store_si512(to + kHalves, both(planes[0], planes[1]));
      _mm512_store_si512(to + 2 * kHalves, both(planes[1], planes[0]));
    }
    to += 2 * kHalves;
  }
}

template <int P, class S>
void pack(const Job& job, Part& part) {
  const int64_t parities = part.of.corners ? 4 : 1, lines = part.lines<S>();
  part.plan<P>();
  part.packed = part.memory.reserve<Half>(parities * job.tiles() * lines * part.size);
  Half* to = part.packed;
  for (int64_t parity = 0; parity < parities; ++parity)
    for (int64_t t = 0; t < job.tiles(); ++t)
      for (int64_t line = 0; line < lines; ++line, to += part.size)
        pack_line<P, S>(job, part, parity, t, line, to);
}

// 32 values of each line, from k on.
template <int P, class S>
inline void round_lines(const float* const (&from)[S::Q], const __mmask32 (&there)[S::Q], int64_t k, __mmask32 wanted,
                        Half* to, const Patch& patch) {
  __m512 low[S::Q], high[S::Q], a[S::Q], b[S::Q];
  for (int q = 0; q < S::Q; ++q) {
    const __mmask32 kept = there[q] & wanted;
    low[q] = _mm512_maskz_loadu_ps(kept, from[q] + k);
    high[q] = _mm512_maskz_loadu_ps(kept >> kTile, from[q] + k + kTile);
  }
  to_lines<S>(low, a);
  to_lines<S>(high, b);
  for (int q = 0; q < S::Q; ++q, to += patch.row)
    for (int p = 0; p < P; ++p) {
      const __m512i both = (__m512i)_mm512_cvtne2ps_pbh(b[q], a[q]);
      _mm512_mask_storeu_epi16(to + p * patch.plane, wanted, both);
      if (p + 1 == P) break;
      a[q] = rest(a[q], widened(_mm512_castsi512_si256(both)));
      b[q] = rest(b[q], widened(_mm512_extracti64x4_epi64(both, 1)));
    }
}

inline __m512i upper() { return _mm512_set1_epi32(0xffff0000); }

// What cutting x off after 8 of its 24 bits leaves: three times 8 bits are all of it.
inline __m512 uncut(__m512 x) { return rest(x, (__m512)_mm512_and_si512((__m512i)x, upper())); }

// The upper halves of both: low >> 16 | high & upper.
inline __m512i paired(__m512 low, __m512 high) {
  return _mm512_ternarylogic_epi32(upper(), (__m512i)high, _mm512_srli_epi32((__m512i)low, 16), 0xea);
}

// 32 values of each line, from k on.
template <class S>
inline void weave(const float* const (&from)[S::Q], const __mmask32 (&there)[S::Q], int64_t k, Half* to,
                  const Patch& patch) {
  __m512 low[S::Q], high[S::Q], a[S::Q], b[S::Q];
  for (int q = 0; q < S::Q; ++q) {
    low[q] = _mm512_maskz_loadu_ps(there[q], from[q] + k);
    high[q] = _mm512_maskz_loadu_ps(there[q], from[q] + k + kTile);
  }
  to_lines<S>(low, a);
  to_lines<S>(high, b);
  for (int q = 0; q < S::Q; ++q, to += patch.row)
    for (int p = 0; p < 3; ++p) {
      _mm512_store_si512(to + p * kDepth, paired(a[q], b[q]));
      if (p == 2) break;
      a[q] = uncut(a[q]), b[q] = uncut(b[q]);
    }
}

// 16 values of each line, from k on: planes 1 and 0, and 0 and 2.
template <class S>
inline void weave_half(const float* const (&from)[S::Q], const __mmask32 (&there)[S::Q], int64_t k, Half* to,
                       const Patch& patch) {
  __m512 values[S::Q], a[S::Q];
  for (int q = 0; q < S::Q; ++q) values[q] = _mm512_maskz_loadu_ps(there[q], from[q] + k);
  to_lines<S>(values, a);
  for (int q = 0; q < S::Q; ++q, to += patch.row) {
    const __m512 second = uncut(a[q]), third = uncut(second);
    _mm512_store_si512(to, paired(second, a[q]));
    _mm512_store_si512(to + kDepth, paired(a[q], third));
  }
}

// Lines of the rows from `y` on, so many times R of them, and of columns from patch.x: zeros beyond the image, as P
// bfloat16 each.
template <int P, class S>
void gather(const Part& part, int64_t image, int64_t y, int64_t times, int64_t columns, Memory& memory,
            Patch& patch) {
  const Source& s = part.of;
  patch.pixel = part.woven ? (3 * part.steps + 2 * part.half) * kDepth : s.c;
  patch.step = part.woven ? 3 * kDepth : kDepth;
  patch.row = columns * patch.pixel;
  // A block may reach beyond the last pixel: what it finds there is not kept, but must be there to be read.
  const int64_t beyond = (2 * kPixels + s.kw) * patch.pixel + 2 * kDepth, lines = times * S::Q;
  const int64_t size = (lines * patch.row + beyond + kDepth - 1) / kDepth * kDepth;
  const int64_t planes = part.woven ? 1 : P;
  patch.plane = part.woven ? kDepth : size;
  patch.data = memory.reserve<Half>(planes * size);
  const int64_t begin = std::clamp<int64_t>(-patch.x, 0, columns);
  const int64_t end = std::max(std::clamp<int64_t>(s.w - patch.x, 0, columns), begin);
  auto clear = [&](int64_t from, int64_t count) {
    for (int64_t p = 0; p < planes; ++p) std::memset(patch.data + p * size + from, 0, count * sizeof(Half));
  };
  if (!part.woven) clear(lines * patch.row, size - lines * patch.row);
  for (int64_t n = 0; n < times; ++n) {
    Half* to = patch.data + n * S::Q * patch.row;
    for (int q = 0; q < S::Q; ++q) {
      const int64_t line = to + q * patch.row - patch.data;
      clear(line, begin * patch.pixel);
      clear(line + end * patch.pixel, patch.row - end * patch.pixel);
    }
    const float* from[S::Q];
    __mmask32 there[S::Q];
    for (int q = 0; q < S::Q; ++q) {
      const int64_t r = y + (n * S::R + q) * part.every;
      there[q] = r >= 0 && r < s.h ? ~0u : 0;
      from[q] = s.image + ((image * s.h + (there[q] ? r : 0)) * s.w + patch.x) * s.c;
    }
    if (part.woven) {
      for (int64_t x = begin; x < end; ++x) {
        Half* pixel = to + x * patch.pixel;
        for (int64_t k = 0; k < part.steps; ++k)
          weave<S>(from, there, x * s.c + k * kDepth, pixel + k * patch.step, patch);
        if (part.half) weave_half<S>(from, there, (x + 1) * s.c - kTile, pixel + part.steps * patch.step, patch);
      }
      continue;
    }
    for (int64_t k = begin * s.c; k < end * s.c; k += kDepth) {
      const int64_t left = end * s.c - k;
      const __mmask32 wanted = static_cast<__mmask32>(first(left - kTile)) << kTile | first(left);
      round_lines<P, S>(from, there, k, wanted, to + k, patch);
    }
  }
}

struct Place {
  int64_t image, i, j, y, x, t;  // i, j: parity; y, x: cell; t: first tile of outputs
};

// Where values of a block pass, and as what.
struct Mask {
  const uint8_t* inside = nullptr;  // of its first pixel
  const uint8_t* gate = nullptr;    // of its first pixel and output
  char bit = 1;

  Mask() = default;
  Mask(const Job& job, const Place& at, int64_t row) {
    const int64_t y = (at.y + row) * job.step + at.i, x = at.x * job.step + at.j;
    if (job.inside) inside = job.inside + ((job.images > 1 ? at.image : 0) * job.H + y) * job.W + x;
    if (job.gate)
      gate = job.gate + ((at.image * (job.H / job.bits) + y / job.bits) * job.W + x) * job.outputs + at.t * kTile;
    bit = static_cast<char>(1 << y % job.bits);
  }

  // Whether any value of those pixels passes. Where all are inside, that need not be asked again.
  bool any(const Job& job, const Place& at, int64_t pixels) {
    int64_t found = inside ? 0 : pixels;
    for (int64_t p = 0; inside && p < pixels; ++p) found += inside[p * job.step] != 0;
    if (found == pixels) inside = nullptr;
    if (!found || !gate) return found;
    const int64_t left = job.outputs - at.t * kTile;
    const __mmask32 wanted = left >= 2 * kTile ? ~0u : (1u << left) - 1;
    __m256i all = _mm256_setzero_si256();
    for (int64_t p = 0; p < pixels; ++p)
      all = _mm256_or_si256(all, _mm256_maskz_loadu_epi8(wanted, gate + p * job.step * job.outputs));
    return !_mm256_testz_si256(all, _mm256_set1_epi8(bit));
  }
};

// 32 pixels by 32 outputs by R rows, or 64 by 16 where no more outputs are left.
template <class S>
struct Block {
  Place at;
  int64_t rows, pixels, outputs;
  Mask masks[S::R];
};

// Whole lines around the caches: what is there need not be read first, and is not wanted again before all is written.
inline void write(float* to, __mmask16 wanted, __m512 value) {
  if (wanted == 0xffff && reinterpret_cast<uintptr_t>(to) % 64 == 0) _mm512_stream_ps(to, value);
  else _mm512_mask_storeu_ps(to, wanted, value);
}

// Writing a block's sums through bias, addend, ReLU, gate and bounds, some pixels by 16 outputs by R rows at a time.
template <class S>
class Finishing {
 public:
  void begin(const Job& job, const Block<S>& block, const float* sums) {
    job_ = &job, block_ = block, sums_ = sums;
    half_ = -1, pixel_ = block.pixels;
    left_ = block.outputs / kTile * block.pixels;
    plain_ = block.rows == S::R;
    for (int64_t r = 0; r < block.rows; ++r) plain_ = plain_ && !block.masks[r].gate && !block.masks[r].inside;
  }

  int64_t left() const { return (left_ + kAtOnce - 1) / kAtOnce; }

  void all() {
    while (advance()) {}
  }

  // As part of every loop that calls it, it takes no less time and a quarter longer to compile.
  __attribute__((noinline)) bool advance() {
    if (!left_) return false;
    if (pixel_ == block_.pixels) next_half();
    const int64_t count = std::min<int64_t>(kAtOnce, block_.pixels - pixel_);
    if (plain_ && count == kAtOnce) some<true>(kAtOnce);
    else some<false>(count);
    pixel_ += count, left_ -= count;
    at_ += count * next_;
    return true;
  }

 private:
  static constexpr int64_t kAtOnce = 4;

  template <bool Plain>
  inline void some(int64_t count) {
    const Job& job = *job_;
    const __m512 zero = _mm512_setzero_ps(), bias = bias_;
    const __mmask16 wanted = wanted_;
    const bool relu = job.relu;
    const int64_t next = next_, row = row_;
    const float* sums = sums_ + pixel_ * block_.outputs + half_ * kTile;
    const float* plus = job.plus ? job.plus + at_ : nullptr;
    float* out = job.out + at_;
    for (int64_t p = 0; p < count; ++p, sums += block_.outputs, out += next) {
      __m512 lines[S::Q], rows[S::R];
      for (int q = 0; q < S::Q; ++q) lines[q] = _mm512_load_ps(sums + q * kSums);
      fold<S>(lines);
      to_rows<S>(lines, rows);
#pragma GCC unroll 4
      for (int r = 0; r < S::R; ++r) {
        if (!Plain && r >= block_.rows) break;
        __m512 value = _mm512_add_ps(rows[r], bias);
        if (plus) value = _mm512_add_ps(value, _mm512_maskz_loadu_ps(wanted, plus + p * next + r * row));
        if (!Plain) {
          const Mask& mask = block_.masks[r];
          if (mask.gate) {
            const uint8_t* of = mask.gate + (pixel_ + p) * next + half_ * kTile;
            const __mmask16 passes = _mm_test_epi8_mask(_mm_maskz_loadu_epi8(wanted, of), _mm_set1_epi8(mask.bit));
            value = _mm512_maskz_mov_ps(passes, value);
          }
          if (mask.inside && !mask.inside[(pixel_ + p) * job.step]) value = zero;
        }
        // Of NaN the second is taken.
        if (relu) value = _mm512_max_ps(value, zero);
        write(out + r * row, wanted, value);
      }
    }
  }

  void next_half() {
    const Job& job = *job_;
    const Place& at = block_.at;
    const int64_t output = at.t * kTile + ++half_ * kTile;
    const int64_t y = at.y * job.step + at.i, x = at.x * job.step + at.j;
    pixel_ = 0;
    next_ = job.step * job.outputs;
    row_ = next_ * job.W;
    at_ = ((at.image * job.H + y) * job.W + x) * job.outputs + output;
    wanted_ = first(job.outputs - output);
    bias_ = job.bias ? _mm512_maskz_loadu_ps(wanted_, job.bias + output) : _mm512_setzero_ps();
  }

  const Job* job_;
  Block<S> block_;
  const float* sums_;
  int64_t half_, pixel_, left_ = 0, at_, next_, row_;
  bool plain_;
  __mmask16 wanted_;
  __m512 bias_;
};

// M by N tiles of sums: 0 to 3. Of pixels 4 and 5, of kernels 6 and 7.
template <int M>
inline void load_pixels(const Half* from, int64_t stride) {
  _tile_loadd(4, from, stride * sizeof(Half));
  if (M > 1) _tile_loadd(5, from + kTile * stride, stride * sizeof(Half));
}

template <int N>
inline void load_kernels(const Half* from, int64_t next) {
  _tile_loadd(6, from, 64);
  if (N > 1) _tile_loadd(7, from + next, 64);
}

template <int M, int N>
inline void multiply() {
  _tile_dpbf16ps(0, 4, 6);
  if (N > 1) _tile_dpbf16ps(1, 4, 7);
  if (M > 1) _tile_dpbf16ps(2, 5, 6);
  if (M > 1 && N > 1) _tile_dpbf16ps(3, 5, 7);
}

// Pixels in tile 7 by a tile of kernels, 4 to 6, to sums m.
template <int m, int kernel>
inline void multiply_one() {
  if (m == 0 && kernel == 4) _tile_dpbf16ps(0, 7, 4);
  if (m == 1 && kernel == 4) _tile_dpbf16ps(1, 7, 4);
  if (m == 2 && kernel == 4) _tile_dpbf16ps(2, 7, 4);
  if (m == 3 && kernel == 4) _tile_dpbf16ps(3, 7, 4);
  if (m == 0 && kernel == 5) _tile_dpbf16ps(0, 7, 5);
  if (m == 1 && kernel == 5) _tile_dpbf16ps(1, 7, 5);
  if (m == 2 && kernel == 5) _tile_dpbf16ps(2, 7, 5);
  if (m == 3 && kernel == 5) _tile_dpbf16ps(3, 7, 5);
  if (m == 0 && kernel == 6) _tile_dpbf16ps(0, 7, 6);
  if (m == 1 && kernel == 6) _tile_dpbf16ps(1, 7, 6);
  if (m == 2 && kernel == 6) _tile_dpbf16ps(2, 7, 6);
  if (m == 3 && kernel == 6) _tile_dpbf16ps(3, 7, 6);
}

// Four tiles of pixels by one of outputs, of three planes: kernels stay, so that 24 products take 15 loads, where
// two by one take 20. In the same order, for the same bits.
template <int... m>
inline void add_wide(std::integer_sequence<int, m...>, bool half, const Half* at, int64_t stride, int64_t plane,
                     const Half* kernels) {
  auto load = [&](int64_t p, int64_t tile) {
    _tile_loadd(7, at + p * plane + tile * kTile * stride, stride * sizeof(Half));
  };
  _tile_loadd(4, kernels, 64);
  _tile_loadd(5, kernels + kHalves, 64);
  _tile_loadd(6, kernels + 2 * kHalves, 64);
  if (half) {
    ((load(1, m), multiply_one<m, 4>()), ...);
    ((load(0, m), multiply_one<m, 5>(), multiply_one<m, 6>()), ...);
  } else {
    ((load(2, m), multiply_one<m, 4>()), ...);
    ((load(1, m), multiply_one<m, 4>(), multiply_one<m, 5>()), ...);
    ((load(0, m), multiply_one<m, 5>(), multiply_one<m, 6>(), multiply_one<m, 4>()), ...);
  }
}

// Small products first.
template <int P, int M, int N>
inline void add_step(const Half* at, int64_t stride, int64_t plane, const Half* kernels, int64_t next) {
  if (P == 3) {
    load_pixels<M>(at + 2 * plane, stride);
    load_kernels<N>(kernels, next);
    multiply<M, N>();
  }
  if (P >= 2) {
    load_pixels<M>(at + plane, stride);
    if (P == 2) load_kernels<N>(kernels, next);
    multiply<M, N>();
    load_kernels<N>(kernels + kHalves, next);
    if (P == 3) multiply<M, N>();
  }
  load_pixels<M>(at, stride);
  if (P >= 2) multiply<M, N>();
  if (P == 3) {
    load_kernels<N>(kernels + 2 * kHalves, next);
    multiply<M, N>();
  }
  load_kernels<N>(kernels, next);
  multiply<M, N>();
}

template <int M, int N>
inline void add_half(const Half* at, int64_t stride, int64_t plane, const Half* kernels, int64_t next) {
  load_pixels<M>(at + plane, stride);
  load_kernels<N>(kernels, next);
  multiply<M, N>();
  load_pixels<M>(at, stride);
  load_kernels<N>(kernels + kHalves, next);
  multiply<M, N>();
  load_kernels<N>(kernels + 2 * kHalves, next);
  multiply<M, N>();
}

// Between products vector units write the block before.
template <int P, int M, int N, class S>
inline void add_lines(const Part& part, const Half* pixels, int64_t stride, const Patch& patch, const Half* kernels,
                      int64_t next, int64_t lines, Finishing<S>& before, int64_t each) {
  alignas(64) float unused[kTile * kTile];
  int64_t done = 0;
  auto between = [&] {
    // Kept by nobody: without it storing the sums takes 0.3 us longer, as after any 130 products or more.
    if (++done % 4 == 0) _tile_stored(6, unused, 64);
    for (int64_t n = 0; n < each; ++n) before.advance();
  };
  auto add = [&](bool half, const Half* at) {
    if constexpr (M == 4) add_wide(std::make_integer_sequence<int, M>(), half, at, stride, patch.plane, kernels);
    else if (half) add_half<M, N>(at, stride, patch.plane, kernels, next);
    else add_step<P, M, N>(at, stride, patch.plane, kernels, next);
    kernels += P * kHalves;
    between();
  };
  for (int64_t line = 0; line < lines; ++line, pixels += patch.row)
    for (int64_t tap = 0; tap < part.across; ++tap) {
      const Half* at = pixels + tap * patch.pixel;
      for (int64_t k = 0; k < part.steps; ++k, at += patch.step) add(false, at);
      if (P == 3 && part.half) add(true, at);
    }
}

// Of a block from the patches' line on.
template <int P, int M, int N, class S>
void add_block(const Job& job, const Patch* patches, int64_t line, const Place& at, float* sums,
               Finishing<S>& before) {
  constexpr int64_t kRow = N * kTile;
  int64_t steps = 0;
  for (const Part& part : job.parts) steps += part.lines<S>() * part.all_steps();
  const int64_t each = (before.left() + steps - 1) / steps;
  for (int q = 0; q < S::Q; ++q, sums += kSums) {
    _tile_zero(0);
    _tile_zero(1);
    _tile_zero(2);
    _tile_zero(3);
    for (size_t n = 0; n < job.parts.size(); ++n) {
      const Part& part = job.parts[n];
      const Source& s = part.of;
      const Patch& patch = patches[n];
      const int64_t lines = part.lines<S>();
      const int64_t parity = s.corners ? 2 * at.i + at.j : 0;
      const int64_t x = s.corners ? at.x + at.j - 1 : at.x * job.step + at.j - s.kw / 2;
      const Half* pixels = patch.data + (line + q) * patch.row + (x - patch.x) * patch.pixel;
      const Half* kernels = part.packed + ((parity * job.tiles() + at.t) * lines + q) * part.size;
      add_lines<P, M, N, S>(part, pixels, (s.corners ? 1 : job.step) * patch.pixel, patch, kernels, lines * part.size,
                            S::kSummed ? lines : 1, before, each);
    }
    _tile_stored(0, sums, kRow * sizeof(float));
    if (N > 1) _tile_stored(1, sums + kTile, kRow * sizeof(float));
    if (M == 4) _tile_stored(1, sums + kTile * kRow, kRow * sizeof(float));
    if (M > 1) _tile_stored(2, sums + M / 2 * kTile * kRow, kRow * sizeof(float));
    if (M > 1 && N > 1) _tile_stored(3, sums + kTile * kRow + kTile, kRow * sizeof(float));
    if (M == 4) _tile_stored(3, sums + 3 * kTile * kRow, kRow * sizeof(float));
  }
}

void zero(const Job& job, const Place& at, int64_t rows, int64_t pixels) {
  const int64_t x = at.x * job.step + at.j, output = at.t * kTile;
  const int64_t bytes = std::min(2 * kTile, job.outputs - output) * sizeof(float);
  for (int64_t r = 0; r < rows; ++r) {
    const int64_t y = (at.y + r) * job.step + at.i;
    float* out = job.out + ((at.image * job.H + y) * job.W + x) * job.outputs + output;
    for (int64_t p = 0; p < pixels; ++p, out += job.step * job.outputs) std::memset(out, 0, bytes);
  }
}

// What the parts have around those cells, for rows of that parity.
template <int P, class S>
void gather_all(const Job& job, const Place& at, int64_t y0, int64_t y1, int64_t x0, int64_t x1, Memory* memory,
                Patch* patches) {
  for (size_t n = 0; n < job.parts.size(); ++n) {
    const Part& part = job.parts[n];
    const Source& s = part.of;
    const int64_t per = s.corners ? 1 : job.step, edge = s.corners ? 0 : 1;
    const int64_t times = S::kSummed ? y1 - y0 + part.taps.size() - 1 : (y1 - y0 + S::R - 1) / S::R;
    patches[n].x = x0 * per - s.kw / 2;
    gather<P, S>(part, at.image, y0 * part.every + part.offset + at.i, times, (x1 - x0) * per + s.kw - edge,
                 memory[n], patches[n]);
  }
}

// Blocks of a task, one after the other.
template <int P, class S>
class Blocks {
 public:
  Blocks(const Job& job, int64_t x0, int64_t x1, Memory* memory) : job_(job), x0_(x0), x1_(x1), memory_(memory) {}

  // Of rows that are gathered together, of one parity.
  void rows(Place at, int64_t y0, int64_t y1) {
    bool gathered = false;
    for (at.j = 0; at.j < job_.step; ++at.j)
      for (at.t = 0; at.t < job_.tiles(); at.t += 2)
        for (at.y = y0; at.y < y1; at.y += S::R) {
          const bool last = job_.tiles() - at.t == 1;
          // Few outputs alone are written slower by twice as many pixels.
          const int64_t most = last && at.t && P == 3 ? 2 * kPixels : kPixels;
          for (at.x = x0_; at.x < x1_; at.x += most) {
            const int64_t pixels = std::min(most, x1_ - at.x), outputs = (last ? 1 : 2) * kTile;
            Block<S> block{at, std::min<int64_t>(S::R, y1 - at.y), pixels, outputs, {}};
            // Padding around an image is all zeros, and costs no more than writing them.
            if (!passes(block)) {
              zero(job_, at, block.rows, block.pixels);
              continue;
            }
            if (!gathered) gather_all<P, S>(job_, at, y0, y1, x0_, x1_, memory_, patches_);
            gathered = true;
            add(block, (at.y - y0) / S::R * S::Q);
          }
        }
  }

  void finish() { before_.all(); }

 private:
  bool passes(Block<S>& block) const {
    bool any = false;
    for (int64_t r = 0; r < block.rows; ++r) {
      block.masks[r] = Mask(job_, block.at, r);
      any = block.masks[r].any(job_, block.at, block.pixels) || any;
    }
    return any;
  }

  void add(const Block<S>& block, int64_t line) {
    const bool one = block.pixels <= kTile, last = block.outputs == kTile;
    auto add = one ? last ? add_block<P, 1, 1, S> : add_block<P, 1, 2, S>
                   : last ? add_block<P, 2, 1, S> : add_block<P, 2, 2, S>;
    if (P == 3 && block.pixels > kPixels) add = add_block<3, 4, 1, S>;
    add(job_, patches_, line, block.at, sums_[turn_], before_);
    before_.all();
    before_.begin(job_, block, sums_[turn_]);
    turn_ ^= 1;
  }

  const Job& job_;
  const int64_t x0_, x1_;
  Memory* memory_;
  Patch patches_[3];
  alignas(64) float sums_[2][S::Q * kSums];
  Finishing<S> before_;
  int turn_ = 0;
};

template <int P, class S>
void task(const Job& job, int64_t index) {
  thread_local Memory memory[3];
  const int64_t h = job.H / job.step, w = job.W / job.step, height = job.height<S>();
  const int64_t across = (w + job.columns - 1) / job.columns, down = (h + job.rows - 1) / job.rows;
  Place at{};
  at.image = index / (across * down);
  const int64_t y0 = index / across % down * job.rows, x0 = index % across * job.columns;
  const int64_t y1 = std::min(h, y0 + job.rows), x1 = std::min(w, x0 + job.columns);
  const Palette palette;
  _tile_loadconfig(&palette);
  Blocks<P, S> blocks(job, x0, x1, memory);
  for (at.i = 0; at.i < job.step; ++at.i)
    for (int64_t y = y0; y < y1; y += height) blocks.rows(at, y, std::min(y1, y + height));
  blocks.finish();
  _mm_sfence();
  _tile_release();
}

// Of so many tasks, those that nobody began. Whoever waits works, so that a full pool cannot stop it.
struct Tasks {
  std::function<void(int64_t)> run;
  int64_t count, done = 0;
  std::atomic<int64_t> next{0};
  std::mutex mutex;
  std::condition_variable all;

  void work() {
    int64_t mine = 0;
    for (int64_t i; (i = next.fetch_add(1)) < count; ++mine) run(i);
    if (!mine) return;
    std::lock_guard<std::mutex> lock(mutex);
    done += mine;
    if (done == count) all.notify_one();
  }
};

void in_parallel(ffi::ThreadPool& pool, int64_t count, std::function<void(int64_t)> run) {
  auto tasks = std::make_shared<Tasks>();
  tasks->run = std::move(run);
  tasks->count = count;
  const int64_t helpers = std::min<int64_t>(pool.num_threads(), count) - 1;
  for (int64_t i = 0; i < helpers; ++i) pool.Schedule([tasks] { tasks->work(); });
  tasks->work();
  std::unique_lock<std::mutex> lock(tasks->mutex);
  tasks->all.wait(lock, [&] { return tasks->done == tasks->count; });
}

template <int P, class S>
void run(Job& job, ffi::ThreadPool& pool) {
  for (Part& part : job.parts) pack<P, S>(job, part);
  job.rows = kTile / job.step;
  job.columns = 4 * kPixels;
  auto bytes = [&] {
    int64_t total = 0;
    for (const Part& part : job.parts) {
      const Source& s = part.of;
      const int64_t lines = S::kSummed ? job.rows + part.taps.size() - 1 : S::Q;
      total += lines * (job.columns * (s.corners ? 1 : job.step) + s.kw) * s.c * P * sizeof(Half);
    }
    return total;
  };
  while (job.columns > kPixels && bytes() > kPatch) job.columns /= 2;
  while (S::kSummed && job.rows > 1 && bytes() > kPatch) job.rows /= 2;
  const int64_t h = job.H / job.step, w = job.W / job.step;
  const int64_t count = job.n * ((h + job.rows - 1) / job.rows) * ((w + job.columns - 1) / job.columns);
  in_parallel(pool, count, [&job](int64_t index) { task<P, S>(job, index); });
}

// By lines of at most so many rows of outputs, where a row of taps is long enough: of short ones sums round little.
void run_in_float32(Job& job, ffi::ThreadPool& pool, int64_t together) {
  auto all = [&](size_t least, size_t most) {
    return std::all_of(job.parts.begin(), job.parts.end(), [&](const Part& part) {
      return part.taps.size() >= least && part.taps.size() <= most;
    });
  };
  const bool is_long = std::any_of(job.parts.begin(), job.parts.end(),
                                   [](const Part& part) { return part.of.kw * part.of.c > kDepth; });
  const int64_t rows = is_long ? together / job.step : 1;
  if (rows >= 2 && job.step == 2 && all(1, 2))
    return rows >= 4 ? run<3, Toom42>(job, pool) : run<3, Toom22>(job, pool);
  if (rows >= 2 && job.step == 1 && all(3, 3))
    return rows >= 4 ? run<3, Toom43>(job, pool) : run<3, Toom23>(job, pool);
  if (rows >= 2 && job.step == 1 && all(5, 5)) return run<3, Toom25>(job, pool);
  run<3, Direct>(job, pool);
}

// A large output's first touch otherwise takes as long as a small convolution, a page of 4 KiB at a time.
void ask_for_huge_pages(void* memory, size_t bytes) {
  constexpr uintptr_t kHuge = 2 << 20;
  const uintptr_t at = reinterpret_cast<uintptr_t>(memory);
  const uintptr_t begin = (at + kHuge - 1) / kHuge * kHuge, end = (at + bytes) / kHuge * kHuge;
  if (begin < end) madvise(reinterpret_cast<void*>(begin), end - begin, MADV_HUGEPAGE);
}

using Floats = ffi::Buffer<ffi::F32>;
using Bytes = ffi::Buffer<ffi::U8>;

// Absent parts have no elements. low: n, H/2, W/2, c and its kernel 2, 2, c, 4 * outputs in the order of
// parities; image: n, H, W, c and its kernel kh, kw, c, outputs.
ffi::Error convolve(ffi::ThreadPool pool, Floats low, Floats low_kernel, Floats image, Floats kernel, Floats bias,
                    Floats plus, Bytes gate, Bytes inside, ffi::ResultBuffer<ffi::F32> out, int64_t planes,
                    int64_t bits, bool relu, int64_t together) try {
  Job job;
  const auto o = out->dimensions();
  job.n = o[0], job.H = o[1], job.W = o[2], job.outputs = o[3];
  job.out = out->typed_data();
  auto add = [&](const Floats& of, const Floats& by, bool corners) {
    if (!of.element_count()) return;
    const auto d = of.dimensions(), k = by.dimensions();
    const Source s{of.typed_data(), d[1], d[2], d[3], by.typed_data(), k[0], k[1], corners};
    const int64_t every = corners ? 1 : job.step;
    for (int64_t begin = 0; begin < std::min(every, k[0]); ++begin) {
      Part part{s, every, begin - k[0] / 2, {}};
      for (int64_t row = begin; row < k[0]; row += every) part.taps.push_back(row);
      job.parts.push_back(std::move(part));
    }
  };
  add(low, low_kernel, true);
  if (!job.parts.empty()) job.step = 2;
  add(image, kernel, false);
  if (bias.element_count()) job.bias = bias.typed_data();
  if (plus.element_count()) job.plus = plus.typed_data();
  if (gate.element_count()) job.gate = gate.typed_data();
  if (inside.element_count()) job.inside = inside.typed_data(), job.images = inside.dimensions()[0];
  job.bits = bits, job.relu = relu;
  if (!out->element_count()) return ffi::Error::Success();
  ask_for_huge_pages(job.out, out->size_bytes());
  planes == 1   ? run<1, Direct>(job, pool)
  : planes == 2 ? run<2, Direct>(job, pool)
                : run_in_float32(job, pool, together);
  return ffi::Error::Success();
} catch (const std::exception& error) {
  return ffi::Error(ffi::ErrorCode::kResourceExhausted, error.what());
}

}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(progden_convolve, convolve,
                              ffi::Ffi::Bind()
                                  .Ctx<ffi::ThreadPool>()
                                  .Arg<Floats>()
                                  .Arg<Floats>()
                                  .Arg<Floats>()
                                  .Arg<Floats>()
                                  .Arg<Floats>()
                                  .Arg<Floats>()
                                  .Arg<Bytes>()
                                  .Arg<Bytes>()
                                  .Ret<Floats>()
                                  .Attr<int64_t>("planes")
                                  .Attr<int64_t>("bits")
                                  .Attr<bool>("relu")
                                  .Attr<int64_t>("together"));

// Whether the system lets this process use AMX: Linux gives its registers to those that ask.
extern "C" int progden_asks_for_amx() {
  constexpr long kAskFor = 0x1023, kTileData = 18;
  return syscall(SYS_arch_prctl, kAskFor, kTileData) == 0;
}
