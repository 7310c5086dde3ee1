// SPDX-License-Identifier: Apache-2.0
#include "omnister/sim/renderer.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <opencv2/core.hpp>
#include <string>

#include "omnister/common/error.h"
#include "omnister/common/parallel.h"
#include "sim/scene/clones.h"
#include "sim/scene/random.h"
#include "sim/scene/scene_data.h"

namespace omnister::sim {
namespace {

constexpr float kNan = std::numeric_limits<float>::quiet_NaN();
constexpr float kInfinity = std::numeric_limits<float>::infinity();
constexpr int kTileWidth = 32;
constexpr int kTileHeight = 16;
/// Pixels of a tile with one more all around, which tell where surfaces meet.
constexpr int kApron = (kTileWidth + 2) * (kTileHeight + 2);
static_assert(kApron <= kBatch);
/// Surfaces that stand steeper than this are sampled finely even by the adaptive way.
constexpr float kSteep = 0.35f;

/// A surface as one camera sees it: in the surface's own frame, with the camera's centre at
/// `origin`.
struct View {
  const Surface* surface = nullptr;
  Eigen::Matrix3f rotation;  // rays of the camera into the surface's frame
  Eigen::Vector3f origin;    // camera centre in the surface's frame [m]
  Eigen::Vector3f light;     // lamp in the surface's frame [m]
  Eigen::Vector3f half;
  Eigen::Vector2f middle;
  Eigen::Vector3f center;  // of the bounding sphere, in the camera's frame [m]
  float radius = 0.0f;     // of it; infinite for endless planes [m]
};

/// Rays of one batch in the camera's frame, and what they hit.
struct Rays {
  int n = 0;
  std::array<float, kBatch> x, y, z;
  std::array<float, kBatch> angle;       // width of the sample [rad]
  std::array<float, kBatch> range;       // infinite: nothing hit
  std::array<std::int16_t, kBatch> hit;  // index into the views, -1: nothing
};

struct Shades {
  std::array<float, kBatch> red, green, blue;
  std::array<float, kBatch> cosine;  // between ray and normal, 0 to 1; 1 where nothing was hit
  std::array<std::int8_t, kBatch> face;
};

OMNISTER_CLONES
void hitPlane(const View& view, int index, Rays& rays) {
  const float r00 = view.rotation(0, 0), r01 = view.rotation(0, 1), r02 = view.rotation(0, 2);
  const float r10 = view.rotation(1, 0), r11 = view.rotation(1, 1), r12 = view.rotation(1, 2);
  const float r20 = view.rotation(2, 0), r21 = view.rotation(2, 1), r22 = view.rotation(2, 2);
  const float ox = view.origin.x() - view.middle.x(), oy = view.origin.y() - view.middle.y();
  const float oz = view.origin.z();
  const float half_x = view.half.x(), half_y = view.half.y();
  const auto id = static_cast<std::int16_t>(index);
  const int n = rays.n;
  for (int k = 0; k < n; ++k) {
    const float x = rays.x[k], y = rays.y[k], z = rays.z[k];
    const float t = -oz / (r20 * x + r21 * y + r22 * z);
    const float u = std::abs(ox + t * (r00 * x + r01 * y + r02 * z));
    const float v = std::abs(oy + t * (r10 * x + r11 * y + r12 * z));
    const bool hit = (t > 0.0f) & (t < rays.range[k]) & (u <= half_x) & (v <= half_y);
    rays.range[k] = hit ? t : rays.range[k];
    rays.hit[k] = hit ? id : rays.hit[k];
  }
}

OMNISTER_CLONES
void hitBox(const View& view, int index, Rays& rays) {
  const float r00 = view.rotation(0, 0), r01 = view.rotation(0, 1), r02 = view.rotation(0, 2);
  const float r10 = view.rotation(1, 0), r11 = view.rotation(1, 1), r12 = view.rotation(1, 2);
  const float r20 = view.rotation(2, 0), r21 = view.rotation(2, 1), r22 = view.rotation(2, 2);
  const float ox = view.origin.x(), oy = view.origin.y(), oz = view.origin.z();
  const float half_x = view.half.x(), half_y = view.half.y(), half_z = view.half.z();
  const auto id = static_cast<std::int16_t>(index);
  const int n = rays.n;
  for (int k = 0; k < n; ++k) {
    const float x = rays.x[k], y = rays.y[k], z = rays.z[k];
    // A ray along a side divides by zero; a tiny slope gives the same interval without NaN.
    float dx = r00 * x + r01 * y + r02 * z;
    float dy = r10 * x + r11 * y + r12 * z;
    float dz = r20 * x + r21 * y + r22 * z;
    dx = std::abs(dx) < 1e-12f ? 1e-12f : dx;
    dy = std::abs(dy) < 1e-12f ? 1e-12f : dy;
    dz = std::abs(dz) < 1e-12f ? 1e-12f : dz;
    const float ix = 1.0f / dx, iy = 1.0f / dy, iz = 1.0f / dz;
    const float ex = half_x * std::abs(ix), ey = half_y * std::abs(iy), ez = half_z * std::abs(iz);
    const float mx = -ox * ix, my = -oy * iy, mz = -oz * iz;
    float enter = mx - ex;
    enter = my - ey > enter ? my - ey : enter;
    enter = mz - ez > enter ? mz - ez : enter;
    float leave = mx + ex;
    leave = my + ey < leave ? my + ey : leave;
    leave = mz + ez < leave ? mz + ez : leave;
    const float t = enter > 0.0f ? enter : leave;
    const bool hit = (leave >= enter) & (t > 0.0f) & (t < rays.range[k]);
    rays.range[k] = hit ? t : rays.range[k];
    rays.hit[k] = hit ? id : rays.hit[k];
  }
}

OMNISTER_CLONES
void hitSphere(const View& view, int index, Rays& rays) {
  const float cx = view.center.x(), cy = view.center.y(), cz = view.center.z();
  const float square = view.half.x() * view.half.x();
  const auto id = static_cast<std::int16_t>(index);
  const int n = rays.n;
  for (int k = 0; k < n; ++k) {
    const float x = rays.x[k], y = rays.y[k], z = rays.z[k];
    const float along = cx * x + cy * y + cz * z;
    // Distance of the centre from the ray, without the cancellation of |c|^2 - along^2.
    const float px = cx - along * x, py = cy - along * y, pz = cz - along * z;
    const float inside = square - (px * px + py * py + pz * pz);
    const float root = std::sqrt(inside > 0.0f ? inside : 0.0f);
    const float t = along > root ? along - root : along + root;
    const bool hit = (inside > 0.0f) & (t > 0.0f) & (t < rays.range[k]);
    rays.range[k] = hit ? t : rays.range[k];
    rays.hit[k] = hit ? id : rays.hit[k];
  }
}

/// The cone around a batch of rays.
struct Cone {
  Eigen::Vector3f axis = Eigen::Vector3f::UnitZ();
  float half_angle = 4.0f;  // [rad]; pi and more: everything
};

bool maySee(const Cone& cone, const View& view) {
  const float distance = view.center.norm();
  if (!(distance > view.radius)) return true;
  const float angle = std::acos(std::clamp(cone.axis.dot(view.center) / distance, -1.0f, 1.0f));
  return angle <= cone.half_angle + std::asin(view.radius / distance) + 1e-3f;
}

class Frame {
 public:
  Frame(const SceneData& scene, const Pose& T_world_camera) : scene_(scene) {
    const Pose T_camera_world = T_world_camera.inverse();
    for (const Surface& surface : scene.surfaces) {
      const Pose T_local_camera = surface.T_local_world * T_world_camera;
      View view;
      view.surface = &surface;
      view.rotation = T_local_camera.linear().cast<float>();
      view.origin = T_local_camera.translation().cast<float>();
      view.light = (surface.T_local_world * scene.light).cast<float>();
      view.half = surface.half.cast<float>();
      view.middle = surface.middle.cast<float>();
      const Eigen::Vector3d middle(surface.middle.x(), surface.middle.y(), 0.0);
      view.center = (T_camera_world * (surface.T_world_local * middle)).cast<float>();
      view.radius = static_cast<float>(surface.radius());
      views_.push_back(view);
    }
  }

  /// Finds the first surface of every ray. @param cone holds all of them
  void trace(const Cone& cone, Rays& rays) const {
    std::fill_n(rays.range.begin(), rays.n, static_cast<float>(kFarthest));
    std::fill_n(rays.hit.begin(), rays.n, std::int16_t{-1});
    for (std::size_t i = 0; i < views_.size(); ++i) {
      if (!maySee(cone, views_[i])) continue;
      const int index = static_cast<int>(i);
      switch (views_[i].surface->kind) {
        case Surface::Kind::kPlane:
          hitPlane(views_[i], index, rays);
          break;
        case Surface::Kind::kBox:
          hitBox(views_[i], index, rays);
          break;
        case Surface::Kind::kSphere:
          hitSphere(views_[i], index, rays);
          break;
      }
    }
  }

  bool sharp(int hit) const { return views_[hit].surface->sharp; }

  void shade(const Rays& rays, Shades& shades) const {
    for (int k = 0; k < rays.n; ++k) {
      shades.red[k] = scene_.background[0];
      shades.green[k] = scene_.background[1];
      shades.blue[k] = scene_.background[2];
      shades.cosine[k] = 1.0f;
      shades.face[k] = 0;
    }
    // Samples of one surface after the other, so that textures work in batches.
    std::array<std::uint16_t, kBatch> order;
    int left = 0;
    for (int k = 0; k < rays.n; ++k) {
      if (rays.hit[k] >= 0) order[left++] = static_cast<std::uint16_t>(k);
    }
    std::array<std::uint16_t, kBatch> chosen;
    while (left > 0) {
      const std::int16_t hit = rays.hit[order[0]];
      int n = 0;
      int rest = 0;
      for (int i = 0; i < left; ++i) {
        if (rays.hit[order[i]] == hit) {
          chosen[n++] = order[i];
        } else {
          order[rest++] = order[i];
        }
      }
      left = rest;
      shadeSurface(views_[hit], rays, chosen.data(), n, shades);
    }
  }

 private:
  /// @param chosen the samples that hit this surface
  void shadeSurface(const View& view, const Rays& rays, const std::uint16_t* chosen, int n,
                    Shades& shades) const {
    std::array<float, kBatch> u, v, width, lit;
    std::array<std::int8_t, kBatch> side;
    const float ambient = static_cast<float>(scene_.ambient);
    unsigned sides = 0;
    for (int i = 0; i < n; ++i) {
      const int k = chosen[i];
      const Eigen::Vector3f ray = view.rotation * Eigen::Vector3f(rays.x[k], rays.y[k], rays.z[k]);
      const Eigen::Vector3f point = view.origin + rays.range[k] * ray;
      Eigen::Vector3f normal = Eigen::Vector3f::UnitZ();
      switch (view.surface->kind) {
        case Surface::Kind::kPlane:
          u[i] = point.x();
          v[i] = point.y();
          side[i] = ray.z() < 0.0f ? 1 : 0;
          break;
        case Surface::Kind::kBox: {
          int axis = 0;
          (point.cwiseAbs() - view.half).maxCoeff(&axis);
          u[i] = axis == 0 ? point.z() : point.x();
          v[i] = axis == 1 ? point.z() : point.y();
          normal = Eigen::Vector3f::Unit(axis);
          side[i] = static_cast<std::int8_t>(2 * axis + (point[axis] > 0.0f ? 1 : 0));
          break;
        }
        case Surface::Kind::kSphere: {
          // As on a cube around the sphere.
          int axis = 0;
          point.cwiseAbs().maxCoeff(&axis);
          const float scale = view.half.x() / std::abs(point[axis]);
          u[i] = scale * (axis == 0 ? point.z() : point.x());
          v[i] = scale * (axis == 1 ? point.z() : point.y());
          normal = point / view.half.x();
          side[i] = 0;
          break;
        }
      }
      // Faces of one surface show different parts of their texture.
      if (view.surface->kind != Surface::Kind::kPlane) {
        u[i] += 3.7f * static_cast<float>(side[i]);
      }
      const float cosine = std::min(std::abs(normal.dot(ray)), 1.0f);
      width[i] = rays.range[k] * rays.angle[k] / std::max(cosine, 0.02f);
      const Eigen::Vector3f to_light = view.light - point;
      lit[i] = ambient +
               (1.0f - ambient) * std::abs(normal.dot(to_light)) / std::max(to_light.norm(), 1e-6f);
      shades.cosine[k] = cosine;
      shades.face[k] = side[i];
      sides |= 1u << side[i];
    }
    std::array<float, kBatch> red, green, blue;
    // A batch mostly sees one side; otherwise one side after the other.
    if ((sides & (sides - 1)) == 0) {
      int first = 0;
      while ((sides >> first) != 1u) ++first;
      view.surface->textures[first]->evaluate({n, u.data(), v.data(), width.data()}, red.data(),
                                              green.data(), blue.data());
    } else {
      std::array<float, kBatch> part_u, part_v, part_width, part_red, part_green, part_blue;
      for (int face = 0; face < 6; ++face) {
        if ((sides >> face & 1u) == 0) continue;
        int m = 0;
        for (int i = 0; i < n; ++i) {
          if (side[i] != face) continue;
          part_u[m] = u[i];
          part_v[m] = v[i];
          part_width[m] = width[i];
          ++m;
        }
        view.surface->textures[face]->evaluate({m, part_u.data(), part_v.data(), part_width.data()},
                                               part_red.data(), part_green.data(),
                                               part_blue.data());
        m = 0;
        for (int i = 0; i < n; ++i) {
          if (side[i] != face) continue;
          red[i] = part_red[m];
          green[i] = part_green[m];
          blue[i] = part_blue[m];
          ++m;
        }
      }
    }
    for (int i = 0; i < n; ++i) {
      const int k = chosen[i];
      shades.red[k] = lit[i] * red[i];
      shades.green[k] = lit[i] * green[i];
      shades.blue[k] = lit[i] * blue[i];
    }
  }

  const SceneData& scene_;
  std::vector<View> views_;
};

/// Quantiles of the normal distribution at (i + 0.5) / n, scaled to a variance of 1.
const std::vector<float>& normalQuantiles() {
  static const std::vector<float> values = [] {
    constexpr int kCount = 16384;
    std::vector<float> all(kCount);
    double square = 0.0;
    double z = 0.0;
    for (int i = kCount / 2; i < kCount; ++i) {
      // Newton's iteration from the neighbour before.
      const double wanted = (i + 0.5) / kCount;
      for (int step = 0; step < 50; ++step) {
        const double error = 0.5 * std::erfc(-z / std::sqrt(2.0)) - wanted;
        const double change =
            error / (std::exp(-0.5 * z * z) / std::sqrt(2.0 * 3.14159265358979324));
        z -= std::clamp(change, -0.5, 0.5);
        if (std::abs(change) < 1e-12) break;
      }
      all[i] = static_cast<float>(z);
      all[kCount - 1 - i] = static_cast<float>(-z);
      square += 2.0 * z * z;
    }
    const auto scale = static_cast<float>(1.0 / std::sqrt(square / kCount));
    for (float& value : all) value *= scale;
    return all;
  }();
  return values;
}

std::uint8_t toByte(float value) {
  return static_cast<std::uint8_t>(std::clamp(value + 0.5f, 0.0f, 255.0f));
}

void checkOptions(const RenderOptions& options) {
  if (options.supersampling < 1 || options.supersampling > 16) {
    throw Error("supersampling is " + std::to_string(options.supersampling) + ", expected 1 to 16");
  }
  if (!(options.noise_sigma >= 0.0 && options.noise_sigma <= 255.0)) {
    throw Error("noise is " + std::to_string(options.noise_sigma) +
                ", expected 0 to 255 grey levels");
  }
  if (!(options.vignetting >= 0.0 && options.vignetting <= 1.0)) {
    throw Error("vignetting is " + std::to_string(options.vignetting) + ", expected 0 to 1");
  }
}

/// One tile's work.
class Tile {
 public:
  Tile(const Frame& frame, const std::vector<float>& ray_x, const std::vector<float>& ray_y,
       const std::vector<float>& ray_z, int stride, const cv::Rect& area)
      : frame_(frame), ray_x_(ray_x), ray_y_(ray_y), ray_z_(ray_z), stride_(stride), area_(area) {
    collectPixels();
  }

  void run(const RenderOptions& options, Rendering& out) {
    red_.fill(0.0f);
    green_.fill(0.0f);
    blue_.fill(0.0f);
    castCentres();
    const int grid = options.supersampling;
    const bool adaptive = options.adaptive && grid > 1;
    if (adaptive || grid == 1) {
      setWidths(1.0f, centres_);
      frame_.shade(centres_, shades_);
      for (int k = 0; k < inner_; ++k) {
        red_[k] = shades_.red[k];
        green_[k] = shades_.green[k];
        blue_[k] = shades_.blue[k];
      }
      int n = 0;
      if (adaptive) {
        for (int k = 0; k < inner_; ++k) {
          if (needsMore(k)) selected_[n++] = static_cast<std::uint16_t>(k);
        }
      }
      supersample(grid, n);
    } else {
      for (int k = 0; k < inner_; ++k) selected_[k] = static_cast<std::uint16_t>(k);
      supersample(grid, inner_);
    }
    write(options, out);
  }

 private:
  static constexpr int kWide = kTileWidth + 2;

  /// Pixels with a ray: those of the tile first, then those around it.
  void collectPixels() {
    place_.fill(-1);
    int n = 0;
    const auto take = [&](int x, int y) {
      const std::size_t at = static_cast<std::size_t>(area_.y + y + 1) * stride_ +
                             static_cast<std::size_t>(area_.x + x + 1);
      if (std::isnan(ray_x_[at])) return;
      place_[(y + 1) * kWide + x + 1] = static_cast<std::int16_t>(n);
      pixel_x_[n] = static_cast<std::int16_t>(x);
      pixel_y_[n] = static_cast<std::int16_t>(y);
      centres_.x[n] = ray_x_[at];
      centres_.y[n] = ray_y_[at];
      centres_.z[n] = ray_z_[at];
      ++n;
    };
    for (int y = 0; y < area_.height; ++y) {
      for (int x = 0; x < area_.width; ++x) take(x, y);
    }
    inner_ = n;
    for (int y = -1; y <= area_.height; ++y) {
      for (int x = -1; x <= area_.width; ++x) {
        if (y < 0 || y == area_.height || x < 0 || x == area_.width) take(x, y);
      }
    }
    centres_.n = n;
  }

  /// The derivative of a ray by u or v: the mean of both sides, or the one there is.
  Eigen::Vector3f slope(int k, int dx, int dy) const {
    const int at = (pixel_y_[k] + 1) * kWide + pixel_x_[k] + 1;
    const int before = place_[at - dx - dy * kWide];
    const int after = place_[at + dx + dy * kWide];
    const int first = before < 0 ? k : before;
    const int last = after < 0 ? k : after;
    const float steps = static_cast<float>((before >= 0) + (after >= 0));
    if (steps == 0.0f) return Eigen::Vector3f::Zero();
    return Eigen::Vector3f(centres_.x[last] - centres_.x[first],
                           centres_.y[last] - centres_.y[first],
                           centres_.z[last] - centres_.z[first]) /
           steps;
  }

  void castCentres() {
    if (centres_.n == 0) return;
    Eigen::Vector3f sum = Eigen::Vector3f::Zero();
    for (int k = 0; k < centres_.n; ++k) {
      sum += Eigen::Vector3f(centres_.x[k], centres_.y[k], centres_.z[k]);
    }
    if (sum.norm() > 0.1f * static_cast<float>(centres_.n)) {
      cone_.axis = sum.normalized();
      float least = 1.0f;
      for (int k = 0; k < centres_.n; ++k) {
        least = std::min(
            least, cone_.axis.dot(Eigen::Vector3f(centres_.x[k], centres_.y[k], centres_.z[k])));
      }
      // The apron already holds what samples between pixels see.
      cone_.half_angle = std::acos(std::clamp(least, -1.0f, 1.0f)) + 1e-3f;
    }
    for (int k = 0; k < inner_; ++k) {
      du_[k] = slope(k, 1, 0);
      dv_[k] = slope(k, 0, 1);
    }
    frame_.trace(cone_, centres_);
  }

  void setWidths(float share, Rays& rays) const {
    for (int k = 0; k < inner_; ++k) {
      rays.angle[k] = share * std::max(du_[k].norm(), dv_[k].norm());
    }
    for (int k = inner_; k < rays.n; ++k) rays.angle[k] = 1e-3f;
  }

  /// Whether one ray does not tell what a pixel shows.
  bool needsMore(int k) const {
    if (shades_.cosine[k] < kSteep) return true;
    const bool sharp = centres_.hit[k] >= 0 && frame_.sharp(centres_.hit[k]);
    const int at = (pixel_y_[k] + 1) * kWide + pixel_x_[k] + 1;
    for (const int step : {-kWide - 1, -kWide, -kWide + 1, -1, 1, kWide - 1, kWide, kWide + 1}) {
      const int other = place_[at + step];
      if (other >= 0 &&
          (centres_.hit[other] != centres_.hit[k] || shades_.face[other] != shades_.face[k])) {
        return true;
      }
      if (sharp && other >= 0 && std::abs(shades_.red[other] - shades_.red[k]) > 4.0f) return true;
    }
    return false;
  }

  /// Replaces the colours of the selected pixels by the mean of grid x grid samples.
  void supersample(int grid, int n) {
    if (n == 0) return;
    const float step = 1.0f / static_cast<float>(grid);
    const float weight = step * step;
    for (int i = 0; i < n; ++i) {
      const int k = selected_[i];
      red_[k] = green_[k] = blue_[k] = 0.0f;
    }
    samples_.n = n;
    for (int i = 0; i < n; ++i) {
      const int k = selected_[i];
      samples_.angle[i] = step * std::max(du_[k].norm(), dv_[k].norm());
    }
    for (int sy = 0; sy < grid; ++sy) {
      for (int sx = 0; sx < grid; ++sx) {
        const float a = (static_cast<float>(sx) + 0.5f) * step - 0.5f;
        const float b = (static_cast<float>(sy) + 0.5f) * step - 0.5f;
        for (int i = 0; i < n; ++i) {
          const int k = selected_[i];
          const float x = centres_.x[k] + a * du_[k].x() + b * dv_[k].x();
          const float y = centres_.y[k] + a * du_[k].y() + b * dv_[k].y();
          const float z = centres_.z[k] + a * du_[k].z() + b * dv_[k].z();
          const float scale = 1.0f / std::sqrt(x * x + y * y + z * z);
          samples_.x[i] = scale * x;
          samples_.y[i] = scale * y;
          samples_.z[i] = scale * z;
        }
        frame_.trace(cone_, samples_);
        frame_.shade(samples_, shades_);
        for (int i = 0; i < n; ++i) {
          const int k = selected_[i];
          red_[k] += weight * shades_.red[i];
          green_[k] += weight * shades_.green[i];
          blue_[k] += weight * shades_.blue[i];
        }
      }
    }
  }

  void write(const RenderOptions& options, Rendering& out) const {
    const auto vignetting = static_cast<float>(options.vignetting);
    const auto sigma = static_cast<float>(options.noise_sigma);
    const std::vector<float>& quantiles = normalQuantiles();
    const std::uint64_t stream = mix(options.seed);
    for (int k = 0; k < inner_; ++k) {
      const int x = area_.x + pixel_x_[k];
      const int y = area_.y + pixel_y_[k];
      out.range.at<float>(y, x) = centres_.hit[k] >= 0 ? centres_.range[k] : kNan;
      std::array<float, 3> color{blue_[k], green_[k], red_[k]};
      const float cosine = std::max(centres_.z[k], 0.0f);
      const float fall_off = std::max(cosine * cosine * cosine * cosine, 0.05f);
      const float factor = 1.0f - vignetting * (1.0f - fall_off);
      std::uint64_t random = 0;
      if (sigma > 0.0f) {
        random = mix(stream ^
                     (static_cast<std::uint64_t>(y) * static_cast<std::uint64_t>(out.range.cols) +
                      static_cast<std::uint64_t>(x)));
      }
      const auto noise = [&](int channel) {
        return sigma > 0.0f ? sigma * quantiles[random >> (16 * channel) & (quantiles.size() - 1)]
                            : 0.0f;
      };
      if (options.color) {
        auto& pixel = out.image.at<cv::Vec3b>(y, x);
        for (int c = 0; c < 3; ++c) pixel[c] = toByte(factor * color[c] + noise(c));
      } else {
        const float grey = 0.114f * color[0] + 0.587f * color[1] + 0.299f * color[2];
        out.image.at<std::uint8_t>(y, x) = toByte(factor * grey + noise(0));
      }
    }
  }

  const Frame& frame_;
  const std::vector<float>& ray_x_;
  const std::vector<float>& ray_y_;
  const std::vector<float>& ray_z_;
  int stride_;
  cv::Rect area_;
  Cone cone_;
  int inner_ = 0;
  Rays centres_, samples_;
  Shades shades_;
  std::array<std::int16_t, kApron> place_;
  std::array<std::int16_t, kApron> pixel_x_, pixel_y_;
  std::array<std::uint16_t, kApron> selected_;
  std::array<Eigen::Vector3f, kTileWidth * kTileHeight> du_, dv_;
  std::array<float, kTileWidth * kTileHeight> red_, green_, blue_;
};

}  // namespace

Renderer::Renderer(const LensModel& lens, cv::Size size, int threads) : size_(size) {
  constexpr std::int64_t kMostPixels = std::int64_t{1} << 28;
  if (size.width < 1 || size.height < 1 || std::int64_t{size.width} * size.height > kMostPixels) {
    throw Error("image size is " + std::to_string(size.width) + "x" + std::to_string(size.height) +
                ", expected at least one and at most 2^28 pixels");
  }
  const std::size_t stride = static_cast<std::size_t>(size.width) + 2;
  const std::size_t rows = static_cast<std::size_t>(size.height) + 2;
  for (auto* plane : {&ray_x_, &ray_y_, &ray_z_}) plane->assign(stride * rows, kNan);
  parallelFor(
      0, rows, threads,
      [&](std::size_t row) {
        for (std::size_t column = 0; column < stride; ++column) {
          const auto ray =
              lens.unproject({static_cast<double>(column) - 1.0, static_cast<double>(row) - 1.0});
          if (!ray) continue;
          const std::size_t at = row * stride + column;
          ray_x_[at] = static_cast<float>(ray->x());
          ray_y_[at] = static_cast<float>(ray->y());
          ray_z_[at] = static_cast<float>(ray->z());
        }
      },
      8);
}

Rendering Renderer::render(const Scene& scene, const Pose& T_world_camera,
                           const RenderOptions& options) const {
  checkOptions(options);
  if (!T_world_camera.matrix().allFinite()) throw Error("the camera's pose is not finite");
  Rendering out;
  out.image.create(size_, options.color ? CV_8UC3 : CV_8UC1);
  out.image.setTo(cv::Scalar::all(0));
  out.range.create(size_, CV_32FC1);
  out.range.setTo(cv::Scalar::all(kNan));
  const Frame frame(scene.data(), T_world_camera);
  const int across = (size_.width + kTileWidth - 1) / kTileWidth;
  const int down = (size_.height + kTileHeight - 1) / kTileHeight;
  const cv::Rect image({0, 0}, size_);
  parallelFor(0, static_cast<std::size_t>(across) * down, options.threads, [&](std::size_t i) {
    const int index = static_cast<int>(i);
    const cv::Rect area(index % across * kTileWidth, index / across * kTileHeight, kTileWidth,
                        kTileHeight);
    Tile(frame, ray_x_, ray_y_, ray_z_, size_.width + 2, area & image).run(options, out);
  });
  return out;
}

Rendering render(const Scene& scene, const LensModel& lens, cv::Size size,
                 const Pose& T_world_camera, const RenderOptions& options) {
  return Renderer(lens, size, options.threads).render(scene, T_world_camera, options);
}

}  // namespace omnister::sim
