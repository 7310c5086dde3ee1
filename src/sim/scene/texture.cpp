// SPDX-License-Identifier: Apache-2.0
#include "sim/scene/texture.h"

#include <algorithm>
#include <cmath>
#include <opencv2/imgproc.hpp>
#include <utility>
#include <vector>

#include "sim/scene/clones.h"
#include "sim/scene/random.h"

namespace omnister::sim {
namespace {

constexpr int kLatticeBits = 8;
constexpr int kLattice = 1 << kLatticeBits;

/// Random values in [-1, 1) that every noise reads at its own places.
const float* lattice() {
  static const std::vector<float> values = [] {
    std::vector<float> all(kLattice * kLattice);
    for (std::size_t i = 0; i < all.size(); ++i) all[i] = 2.0f * uniform(i) - 1.0f;
    return all;
  }();
  return values.data();
}

/// Standard deviation of lattice noise: sqrt(1/3) of its values, times that of the smooth
/// interpolation.
constexpr float kNoiseDeviation = 0.4288f;

struct Octave {
  float x_u, x_v, x_0;  ///< from surface to lattice coordinates
  float y_u, y_v, y_0;
  float spacing;  ///< [m]
  float amplitude;
};

OMNISTER_CLONES
void addOctave(const Octave& octave, const float* __restrict table, const TextureSamples& samples,
               float* __restrict sum) {
  const Octave o = octave;
  const int n = samples.n;
  const float* __restrict u = samples.u;
  const float* __restrict v = samples.v;
  const float* __restrict width = samples.width;
  constexpr int kMask = kLattice - 1;
  for (int k = 0; k < n; ++k) {
    const float x = o.x_u * u[k] + o.x_v * v[k] + o.x_0;
    const float y = o.y_u * u[k] + o.y_v * v[k] + o.y_0;
    const float x_floor = std::floor(x);
    const float y_floor = std::floor(y);
    const int x0 = static_cast<int>(x_floor) & kMask;
    const int y0 = (static_cast<int>(y_floor) & kMask) << kLatticeBits;
    const int x1 = (x0 + 1) & kMask;
    const int y1 = (y0 + kLattice) & (kMask << kLatticeBits);
    const float tx = x - x_floor;
    const float ty = y - y_floor;
    const float sx = tx * tx * (3.0f - 2.0f * tx);
    const float sy = ty * ty * (3.0f - 2.0f * ty);
    const float top = table[y0 + x0] + sx * (table[y0 + x1] - table[y0 + x0]);
    const float bottom = table[y1 + x0] + sx * (table[y1 + x1] - table[y1 + x0]);
    // A lattice of half the sample's width cannot be seen; one of 1.5 widths is seen whole.
    float weight = o.spacing / width[k] - 0.5f;
    weight = weight < 0.0f ? 0.0f : weight;
    weight = weight > 1.0f ? 1.0f : weight;
    sum[k] += o.amplitude * weight * (top + sy * (bottom - top));
  }
}

/// Squeezes into (-1, 1) without an edge.
OMNISTER_CLONES
void squeeze(int n, float scale, float* values) {
  for (int k = 0; k < n; ++k) {
    const float x = scale * values[k];
    values[k] = x / std::sqrt(1.0f + x * x);
  }
}

class NoiseField {
 public:
  explicit NoiseField(const NoiseParameters& noise)
      : contrast_(static_cast<float>(noise.contrast)) {
    double spacing = noise.scale;
    double amplitude = 1.0;
    double power = 0.0;
    for (int i = 0; i < noise.octaves; ++i) {
      const std::uint64_t key = mix(noise.seed * 64 + static_cast<std::uint64_t>(i));
      const float angle = 6.2831853f * uniform(key);
      const float c = static_cast<float>(std::cos(angle) / spacing);
      const float s = static_cast<float>(std::sin(angle) / spacing);
      octaves_.push_back({c, -s, kLattice * uniform(key + 1), s, c, kLattice * uniform(key + 2),
                          static_cast<float>(spacing), static_cast<float>(amplitude)});
      power += amplitude * amplitude;
      spacing *= 0.5;
      amplitude *= noise.persistence;
    }
    scale_ = 1.0f / (1.2f * kNoiseDeviation * static_cast<float>(std::sqrt(power)));
  }

  /// Noise in (-1, 1).
  void evaluate(const TextureSamples& samples, float* values) const {
    std::fill_n(values, samples.n, 0.0f);
    if (samples.n == 0) return;
    const float narrowest = *std::min_element(samples.width, samples.width + samples.n);
    for (const Octave& octave : octaves_) {
      if (octave.spacing <= 0.5f * narrowest) break;
      addOctave(octave, lattice(), samples, values);
    }
    squeeze(samples.n, scale_, values);
  }

  float contrast() const { return contrast_; }

 private:
  std::vector<Octave> octaves_;
  float contrast_;
  float scale_;
};

void blend(int n, const std::array<Color, 2>& colors, const float* share, float* red, float* green,
           float* blue) {
  float* channels[] = {red, green, blue};
  for (int c = 0; c < 3; ++c) {
    const float first = colors[0][c];
    const float step = colors[1][c] - first;
    for (int k = 0; k < n; ++k) channels[c][k] = first + share[k] * step;
  }
}

class Noise : public Texture {
 public:
  Noise(const NoiseParameters& noise, const std::array<Color, 2>& colors)
      : field_(noise), colors_(colors) {}
  void evaluate(const TextureSamples& samples, float* red, float* green,
                float* blue) const override {
    std::array<float, kBatch> values;
    field_.evaluate(samples, values.data());
    for (int k = 0; k < samples.n; ++k) values[k] = 0.5f + 0.5f * field_.contrast() * values[k];
    blend(samples.n, colors_, values.data(), red, green, blue);
  }

 private:
  NoiseField field_;
  std::array<Color, 2> colors_;
};

class Grain : public Texture {
 public:
  Grain(TexturePtr base, const NoiseParameters& noise) : base_(std::move(base)), field_(noise) {}
  void evaluate(const TextureSamples& samples, float* red, float* green,
                float* blue) const override {
    base_->evaluate(samples, red, green, blue);
    std::array<float, kBatch> values;
    field_.evaluate(samples, values.data());
    for (int k = 0; k < samples.n; ++k) {
      const float factor = 1.0f + field_.contrast() * values[k];
      red[k] *= factor;
      green[k] *= factor;
      blue[k] *= factor;
    }
  }

 private:
  TexturePtr base_;
  NoiseField field_;
};

class Solid : public Texture {
 public:
  explicit Solid(const Color& color) : color_(color) {}
  void evaluate(const TextureSamples& samples, float* red, float* green,
                float* blue) const override {
    std::fill_n(red, samples.n, color_[0]);
    std::fill_n(green, samples.n, color_[1]);
    std::fill_n(blue, samples.n, color_[2]);
  }

 private:
  Color color_;
};

/// Share of [x - width / 2, x + width / 2] that lies above `edge`.
inline float above(float x, float edge, float width) {
  return std::clamp(0.5f + (x - edge) / width, 0.0f, 1.0f);
}

/// Mean of the square wave of period 2 (+1 on [0, 1), -1 on [1, 2)) over the width.
float squareWave(float x, float width) {
  // The integral of the wave is a triangle.
  const auto triangle = [](float t) {
    t -= 2.0f * std::floor(0.5f * t);
    return t < 1.0f ? t : 2.0f - t;
  };
  return (triangle(x + 0.5f * width) - triangle(x - 0.5f * width)) / width;
}

class Checker : public Texture {
 public:
  Checker(double size, const std::array<Color, 2>& colors)
      : inverse_(static_cast<float>(1.0 / size)), colors_(colors) {}
  void evaluate(const TextureSamples& samples, float* red, float* green,
                float* blue) const override {
    std::array<float, kBatch> share;
    for (int k = 0; k < samples.n; ++k) {
      const float width = std::max(samples.width[k] * inverse_, 1e-3f);
      share[k] = 0.5f - 0.5f * squareWave(samples.u[k] * inverse_, width) *
                            squareWave(samples.v[k] * inverse_, width);
    }
    blend(samples.n, colors_, share.data(), red, green, blue);
  }

 private:
  float inverse_;
  std::array<Color, 2> colors_;
};

class Bricks : public Texture {
 public:
  Bricks(double width, double height, double mortar, double variation, std::uint64_t seed,
         const std::array<Color, 2>& colors)
      : width_(static_cast<float>(width)),
        height_(static_cast<float>(height)),
        half_mortar_(static_cast<float>(0.5 * mortar)),
        variation_(static_cast<float>(variation)),
        seed_(mix(seed)),
        colors_(colors) {}
  void evaluate(const TextureSamples& samples, float* red, float* green,
                float* blue) const override {
    for (int k = 0; k < samples.n; ++k) {
      const float area = std::max(samples.width[k], 1e-6f);
      const float row = std::floor(samples.v[k] / height_);
      const float shift = (static_cast<int>(row) & 1) != 0 ? 0.5f * width_ : 0.0f;
      const float column = std::floor((samples.u[k] + shift) / width_);
      const float x = samples.u[k] + shift - column * width_;
      const float y = samples.v[k] - row * height_;
      const float share = above(std::min(x, width_ - x), half_mortar_, area) *
                          above(std::min(y, height_ - y), half_mortar_, area);
      const auto cell = (static_cast<std::uint64_t>(static_cast<std::int64_t>(row)) << 32) ^
                        static_cast<std::uint32_t>(static_cast<std::int64_t>(column));
      const float factor = 1.0f + variation_ * (uniform(seed_ ^ mix(cell)) - 0.5f);
      const float brick = share * factor;
      red[k] = brick * colors_[0][0] + (1.0f - share) * colors_[1][0];
      green[k] = brick * colors_[0][1] + (1.0f - share) * colors_[1][1];
      blue[k] = brick * colors_[0][2] + (1.0f - share) * colors_[1][2];
    }
  }

 private:
  float width_, height_, half_mortar_, variation_;
  std::uint64_t seed_;
  std::array<Color, 2> colors_;
};

class Dots : public Texture {
 public:
  Dots(double size, double radius, double share, std::uint64_t seed,
       const std::array<Color, 2>& colors)
      : size_(static_cast<float>(size)),
        radius_(static_cast<float>(radius)),
        share_(static_cast<float>(share)),
        seed_(mix(seed)),
        colors_(colors) {}
  void evaluate(const TextureSamples& samples, float* red, float* green,
                float* blue) const override {
    std::array<float, kBatch> dot;
    const float room = size_ - 2.0f * radius_;
    for (int k = 0; k < samples.n; ++k) {
      const float column = std::floor(samples.u[k] / size_);
      const float row = std::floor(samples.v[k] / size_);
      const auto cell = mix((static_cast<std::uint64_t>(static_cast<std::int64_t>(row)) << 32) ^
                            static_cast<std::uint32_t>(static_cast<std::int64_t>(column)) ^ seed_);
      const float x = samples.u[k] - column * size_ - radius_ - room * uniform(cell);
      const float y = samples.v[k] - row * size_ - radius_ - room * uniform(cell + 1);
      const float inside =
          above(radius_, std::sqrt(x * x + y * y), std::max(samples.width[k], 1e-6f));
      dot[k] = uniform(cell + 2) < share_ ? inside : 0.0f;
    }
    blend(samples.n, colors_, dot.data(), red, green, blue);
  }

 private:
  float size_, radius_, share_;
  std::uint64_t seed_;
  std::array<Color, 2> colors_;
};

/// A picture that repeats, with a pyramid for samples wider than its pixels.
class Picture : public Texture {
 public:
  Picture(const cv::Mat& image, double width) : metres_(static_cast<float>(width / image.cols)) {
    levels_.push_back(image.clone());
    while (std::min(levels_.back().cols, levels_.back().rows) > 1) {
      cv::Mat half;
      cv::resize(levels_.back(), half,
                 {(levels_.back().cols + 1) / 2, (levels_.back().rows + 1) / 2}, 0, 0,
                 cv::INTER_AREA);
      levels_.push_back(half);
    }
  }
  void evaluate(const TextureSamples& samples, float* red, float* green,
                float* blue) const override {
    for (int k = 0; k < samples.n; ++k) {
      // The centre of the picture lies at the origin of the surface.
      const float x = samples.u[k] / metres_ / static_cast<float>(levels_[0].cols) + 0.5f;
      const float y = samples.v[k] / metres_ / static_cast<float>(levels_[0].rows) + 0.5f;
      const float level = std::clamp(std::log2(std::max(samples.width[k] / metres_, 1e-6f)), 0.0f,
                                     static_cast<float>(levels_.size() - 1));
      const auto fine = static_cast<std::size_t>(level);
      const std::size_t coarse = std::min(fine + 1, levels_.size() - 1);
      const float share = level - static_cast<float>(fine);
      const Color a = look(levels_[fine], x, y);
      const Color b = look(levels_[coarse], x, y);
      red[k] = a[0] + share * (b[0] - a[0]);
      green[k] = a[1] + share * (b[1] - a[1]);
      blue[k] = a[2] + share * (b[2] - a[2]);
    }
  }

 private:
  static Color look(const cv::Mat& image, float x, float y) {
    x = (x - std::floor(x)) * static_cast<float>(image.cols) - 0.5f;
    y = (y - std::floor(y)) * static_cast<float>(image.rows) - 0.5f;
    const float x_floor = std::floor(x);
    const float y_floor = std::floor(y);
    const float tx = x - x_floor;
    const float ty = y - y_floor;
    const int x0 = (static_cast<int>(x_floor) + image.cols) % image.cols;
    const int y0 = (static_cast<int>(y_floor) + image.rows) % image.rows;
    const int x1 = (x0 + 1) % image.cols;
    const int y1 = (y0 + 1) % image.rows;
    const cv::Vec3b* top = image.ptr<cv::Vec3b>(y0);
    const cv::Vec3b* bottom = image.ptr<cv::Vec3b>(y1);
    Color color;
    for (int c = 0; c < 3; ++c) {
      const float upper =
          static_cast<float>(top[x0][c]) * (1 - tx) + static_cast<float>(top[x1][c]) * tx;
      const float lower =
          static_cast<float>(bottom[x0][c]) * (1 - tx) + static_cast<float>(bottom[x1][c]) * tx;
      color[2 - c] = upper + ty * (lower - upper);
    }
    return color;
  }

  std::vector<cv::Mat> levels_;
  float metres_;
};

/// Black rectangles and dots on white, filtered exactly over the square that a sample stands for.
class Artwork : public Texture {
 public:
  Artwork(const TargetArtwork& art, double dark, double light)
      : dark_(static_cast<float>(dark)), light_(static_cast<float>(light)) {
    const Eigen::Vector2d extent = art.max - art.min;
    const double things = static_cast<double>(art.rectangles.size() + art.dots.size());
    // About one thing a cell.
    const double area = extent.prod() / std::clamp(things, 1.0, 10000.0);
    cell_ = static_cast<float>(std::max(std::sqrt(area), extent.maxCoeff() / 200.0));
    origin_ = art.min.cast<float>();
    cols_ = static_cast<int>(std::ceil(extent.x() / cell_)) + 1;
    rows_ = static_cast<int>(std::ceil(extent.y() / cell_)) + 1;
    cells_.resize(static_cast<std::size_t>(cols_) * rows_);
    for (const auto& r : art.rectangles) {
      addRectangle({static_cast<float>(r.x), static_cast<float>(r.y),
                    static_cast<float>(r.x + r.width), static_cast<float>(r.y + r.height)});
    }
    for (const auto& d : art.dots) {
      addDot({static_cast<float>(d.x), static_cast<float>(d.y), static_cast<float>(d.radius)});
    }
  }

  void evaluate(const TextureSamples& samples, float* red, float* green,
                float* blue) const override {
    for (int k = 0; k < samples.n; ++k) {
      const float black = blackShare(samples.u[k], samples.v[k], std::max(samples.width[k], 1e-7f));
      red[k] = light_ + black * (dark_ - light_);
    }
    std::copy_n(red, samples.n, green);
    std::copy_n(red, samples.n, blue);
  }

 private:
  struct Rectangle {
    float left, top, right, bottom;
  };
  struct Dot {
    float x, y, radius;
  };
  struct Cell {
    std::vector<Rectangle> rectangles;  // cut at the cell's borders
    std::vector<Dot> dots;              // that reach within a cell's size of it
    float black = 0.0f;                 // area of its rectangles
  };

  int column(float x) const {
    return std::clamp(static_cast<int>(std::floor((x - origin_.x()) / cell_)), 0, cols_ - 1);
  }
  int row(float y) const {
    return std::clamp(static_cast<int>(std::floor((y - origin_.y()) / cell_)), 0, rows_ - 1);
  }
  float left(int col) const { return origin_.x() + static_cast<float>(col) * cell_; }
  float top(int row) const { return origin_.y() + static_cast<float>(row) * cell_; }
  const Cell& at(int row, int col) const {
    return cells_[static_cast<std::size_t>(row) * cols_ + col];
  }
  Cell& at(int row, int col) { return cells_[static_cast<std::size_t>(row) * cols_ + col]; }

  void addRectangle(const Rectangle& r) {
    for (int j = row(r.top); j <= row(r.bottom); ++j) {
      for (int i = column(r.left); i <= column(r.right); ++i) {
        const Rectangle part{std::max(r.left, left(i)), std::max(r.top, top(j)),
                             std::min(r.right, left(i + 1)), std::min(r.bottom, top(j + 1))};
        if (part.left >= part.right || part.top >= part.bottom) continue;
        at(j, i).rectangles.push_back(part);
        at(j, i).black += (part.right - part.left) * (part.bottom - part.top);
      }
    }
  }

  void addDot(const Dot& d) {
    const float reach = d.radius + cell_;
    for (int j = row(d.y - reach); j <= row(d.y + reach); ++j) {
      for (int i = column(d.x - reach); i <= column(d.x + reach); ++i) at(j, i).dots.push_back(d);
    }
  }

  float blackShare(float x, float y, float width) const {
    const Rectangle box{x - 0.5f * width, y - 0.5f * width, x + 0.5f * width, y + 0.5f * width};
    float area = 0.0f;
    const int last_row = row(box.bottom);
    const int last_column = column(box.right);
    for (int j = row(box.top); j <= last_row; ++j) {
      for (int i = column(box.left); i <= last_column; ++i) {
        const Cell& cell = at(j, i);
        if (left(i) >= box.left && left(i + 1) <= box.right && top(j) >= box.top &&
            top(j + 1) <= box.bottom) {
          area += cell.black;
          continue;
        }
        for (const Rectangle& r : cell.rectangles) {
          const float across = std::min(box.right, r.right) - std::max(box.left, r.left);
          const float down = std::min(box.bottom, r.bottom) - std::max(box.top, r.top);
          if (across > 0.0f && down > 0.0f) area += across * down;
        }
      }
    }
    float share = area / (width * width);
    for (const Dot& d : at(row(y), column(x)).dots) {
      share += above(d.radius, std::hypot(x - d.x, y - d.y), width);
    }
    return std::min(share, 1.0f);
  }

  float dark_, light_, cell_ = 1.0f;
  Eigen::Vector2f origin_;
  int cols_ = 0, rows_ = 0;
  std::vector<Cell> cells_;
};

}  // namespace

TexturePtr makeNoise(const NoiseParameters& noise, const std::array<Color, 2>& colors) {
  return std::make_shared<Noise>(noise, colors);
}

TexturePtr makeSolid(const Color& color) { return std::make_shared<Solid>(color); }

TexturePtr makeChecker(double size, const std::array<Color, 2>& colors) {
  return std::make_shared<Checker>(size, colors);
}

TexturePtr makeBricks(double width, double height, double mortar, double variation,
                      std::uint64_t seed, const std::array<Color, 2>& colors) {
  return std::make_shared<Bricks>(width, height, mortar, variation, seed, colors);
}

TexturePtr makeDots(double size, double radius, double share, std::uint64_t seed,
                    const std::array<Color, 2>& colors) {
  return std::make_shared<Dots>(size, radius, share, seed, colors);
}

TexturePtr makeImage(const cv::Mat& image, double width) {
  return std::make_shared<Picture>(image, width);
}

TexturePtr makeGrain(TexturePtr base, const NoiseParameters& noise) {
  return std::make_shared<Grain>(std::move(base), noise);
}

BoardTexture makeBoard(const Target& target, double dark, double light) {
  const TargetArtwork art = targetArtwork(target);
  return {std::make_shared<Artwork>(art, dark, light), art.min, art.max, art.margin};
}

}  // namespace omnister::sim
