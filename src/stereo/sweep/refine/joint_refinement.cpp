// SPDX-License-Identifier: Apache-2.0
#include "stereo/sweep/refine/joint_refinement.h"

#include <tbb/enumerable_thread_specific.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <opencv2/imgproc.hpp>

#include "omnister/common/error.h"
#include "omnister/common/parallel.h"

namespace omnister {
namespace {

constexpr float kNaN = std::numeric_limits<float>::quiet_NaN();
constexpr int kRadius = 4;  ///< of the window [px]
constexpr int kWindow = 2 * kRadius + 1;
constexpr int kStripRows = 32;
constexpr int kIterations = 2;
constexpr float kProbe = 0.5f;        ///< path on which gradients are taken, to each side [px]
constexpr float kLargestStep = 1.0f;  ///< of one iteration, in the widest position [px]
constexpr float kNear = 2.0f;         ///< that neighbours on one surface differ by at most [px]
constexpr float kNoise = 3.0f;        ///< variance that windows may differ by for nothing
constexpr float kUnlike = 2.5f;       ///< times the better half's variance: hidden
constexpr float kChance = 0.5f;       ///< times the reference's variance: not the same
constexpr float kDependence = 4.0f;   ///< of neighbouring grey values, in variance
constexpr float kLeastShare = 0.5f;   ///< of a window that must be in the image

/// Sums over windows of kWindow x kWindow; rows [0, rows) of `in` give rows - 2 kRadius of `out`.
void boxSum(const std::vector<float>& in, int rows, int stride, int width, std::vector<float>* line,
            std::vector<float>* out) {
  line->assign(width + 2 * kRadius + 1, 0.0f);
  float* column = line->data() + kRadius;
  for (int y = 0; y < rows - 2 * kRadius; ++y) {
    // Summed afresh in every row: running sums of floats drift.
    const float* from = &in[static_cast<std::size_t>(y) * stride];
    for (int x = 0; x < width; ++x) column[x] = from[x];
    for (int k = 1; k < kWindow; ++k) {
      from += stride;
      for (int x = 0; x < width; ++x) column[x] += from[x];
    }
    float* to = &(*out)[static_cast<std::size_t>(y) * stride];
    const float* window = line->data();
    for (int x = 0; x < width; ++x) {
      float sum = window[x];
      for (int k = 1; k < kWindow; ++k) sum += window[x + k];
      to[x] = sum;
    }
  }
}

/// Mean over a window of those that lie within `near` of the middle: what the window is moved by
/// later must lie on a surface. NaN stays NaN. Rows first, then columns.
void smoothSurface(const cv::Mat& in, float near, int threads, cv::Mat* out) {
  const int width = in.cols, height = in.rows;
  cv::Mat rows(in.size(), CV_32FC1);
  const auto pass = [&](const float* const taps[], int count, float* to) {
    for (int x = 0; x < count; ++x) {
      const float middle = taps[kRadius][x];
      float sum = 0, n = 0;
      for (int k = 0; k < kWindow; ++k) {
        const float value = taps[k][x];
        const float weight = std::fabs(value - middle) <= near ? 1.0f : 0.0f;  // 0 for NaN
        sum += weight * (weight > 0 ? value - middle : 0.0f);
        n += weight;
      }
      to[x] = middle + sum / (n > 0 ? n : 1.0f);
    }
  };
  parallelFor(
      0, static_cast<std::size_t>(height), threads,
      [&](std::size_t row) {
        const int y = static_cast<int>(row);
        std::vector<float> line(width + 2 * kRadius, kNaN);
        std::copy_n(in.ptr<float>(y), width, line.data() + kRadius);
        const float* taps[kWindow];
        for (int k = 0; k < kWindow; ++k) taps[k] = line.data() + k;
        pass(taps, width, rows.ptr<float>(y));
      },
      16);
  parallelFor(
      0, static_cast<std::size_t>(height), threads,
      [&](std::size_t row) {
        const int y = static_cast<int>(row);
        const std::vector<float> none(width, kNaN);
        const float* taps[kWindow];
        for (int k = 0; k < kWindow; ++k) {
          const int v = y + k - kRadius;
          taps[k] = v < 0 || v >= height ? none.data() : rows.ptr<float>(v);
        }
        pass(taps, width, out->ptr<float>(y));
      },
      16);
}

}  // namespace

ProjectionTable::ProjectionTable(const sweep::WideLens& wide, cv::Size size, int threads) {
  const LensModel& lens = *wide.lens;
  const auto ahead = lens.project(Eigen::Vector3d::UnitZ());
  const auto beside = lens.project(Eigen::Vector3d(std::sin(0.01), 0.0, std::cos(0.01)));
  if (!ahead || !beside) throw Error("the displaced lens has no image of its axis");
  focal_px_ = (*beside - *ahead).norm() / 0.01;
  cos_max_ = static_cast<float>(wide.cos_max_theta);
  // Directions are put on the plane by tan(theta / 2), in which every wide-angle lens is smooth.
  const double reach = std::tan(0.5 * std::min(lens.maxTheta(), 2.9));
  constexpr double kStep = 4.0;  // [px] on the axis
  const double wanted = 2.0 * reach * 2.0 * focal_px_ / kStep;
  nodes_ = static_cast<int>(std::clamp(std::ceil(wanted), 64.0, 640.0));
  scale_ = static_cast<float>(0.5 * (nodes_ - 3) / reach);
  middle_ = 0.5f * static_cast<float>(nodes_ - 1);
  table_.resize(static_cast<std::size_t>(nodes_) * nodes_);
  parallelFor(0, static_cast<std::size_t>(nodes_), threads, [&](std::size_t row) {
    const int j = static_cast<int>(row);
    for (int i = 0; i < nodes_; ++i) {
      const double x = (i - middle_) / scale_, y = (j - middle_) / scale_;
      const double square = x * x + y * y;  // of tan(theta / 2)
      const auto pixel = lens.project(Eigen::Vector3d(2 * x, 2 * y, 1 - square));
      const bool near = pixel && pixel->x() > -8.0 && pixel->y() > -8.0 &&
                        pixel->x() < size.width + 7.0 && pixel->y() < size.height + 7.0;
      table_[static_cast<std::size_t>(j) * nodes_ + i] =
          near ? cv::Vec2f(static_cast<float>(pixel->x()), static_cast<float>(pixel->y()))
               : cv::Vec2f(kNaN, kNaN);
    }
  });
}

void ProjectionTable::project(const float* dx, const float* dy, const float* dz, int count,
                              float* u, float* v) const {
  const float last = static_cast<float>(nodes_ - 2);
  for (int i = 0; i < count; ++i) {
    const float length = std::sqrt(dx[i] * dx[i] + dy[i] * dy[i] + dz[i] * dz[i]);
    const float below = length + dz[i];
    const float k = scale_ / (below > 1e-6f * length ? below : 1e-6f * length);
    float x = dx[i] * k + middle_, y = dy[i] * k + middle_;
    const bool inside = dz[i] >= cos_max_ * length && x >= 0 && y >= 0 && x < last && y < last;
    // Also where a direction is NaN.
    u[i] = inside ? x : -1.0f;
    v[i] = inside ? y : -1.0f;
  }
  for (int i = 0; i < count; ++i) {
    if (u[i] < 0) {
      u[i] = v[i] = kNaN;
      continue;
    }
    const int x = static_cast<int>(u[i]), y = static_cast<int>(v[i]);
    const float a = u[i] - static_cast<float>(x), b = v[i] - static_cast<float>(y);
    const cv::Vec2f* p = &table_[static_cast<std::size_t>(y) * nodes_ + x];
    const cv::Vec2f* q = p + nodes_;
    const float w00 = (1 - a) * (1 - b), w10 = a * (1 - b), w01 = (1 - a) * b, w11 = a * b;
    u[i] = w00 * p[0][0] + w10 * p[1][0] + w01 * q[0][0] + w11 * q[1][0];
    v[i] = w00 * p[0][1] + w10 * p[1][1] + w01 * q[0][1] + w11 * q[1][1];
  }
}

/// What a thread keeps between strips.
struct JointRefinement::Strip {
  struct Image {
    std::vector<float> grey, slope, there;  ///< difference to the reference, its derivative, 0 or 1
    std::vector<float> sum, square, count;  ///< over windows
  };
  std::vector<Image> images;
  std::vector<float> line, d[6], u, v, u1, v1, value, box;
  std::vector<cv::Vec3f> rays, full_rays, nodes;
  std::vector<float> cross, slopes, rest, known;  ///< of the normal equations
  std::vector<float> own_sum, own_square, best;
};

JointRefinement::JointRefinement(const StereoGeometry& geometry, int threads, int scale,
                                 float prior_px)
    : geometry_(geometry),
      threads_(threads),
      scale_(scale),
      prior_px_(prior_px),
      rays_(*geometry.reference_lens, geometry.reference_size, threads) {
  setDisplaced(geometry.displaced);
}

void JointRefinement::setDisplaced(const std::vector<StereoGeometry::Displaced>& displaced) {
  geometry_.displaced = displaced;
  table_of_.clear();
  widest_ = 0;
  for (const auto& camera : displaced) {
    std::size_t i = 0;
    while (i < tables_.size() &&
           (tables_[i].lens != camera.lens || tables_[i].size != camera.size)) {
      ++i;
    }
    if (i == tables_.size()) {
      tables_.push_back({camera.lens, camera.size,
                         ProjectionTable(sweep::widen(camera.lens), camera.size, threads_)});
    }
    table_of_.push_back(i);
    widest_ =
        std::max(widest_, static_cast<float>(tables_[i].table.focalPx() *
                                             camera.T_ref_disp.translation().norm() / scale_));
  }
}

std::size_t JointRefinement::refine(const cv::Mat& reference, const std::vector<cv::Mat>& displaced,
                                    const cv::Mat& support, cv::Mat* inverse,
                                    cv::Mat* weight) const {
  const auto smooth = [&](const cv::Mat& image) {
    cv::Mat out;
    if (scale_ == 1) {
      cv::GaussianBlur(image, out, {3, 3}, 0.6);
      return out;
    }
    const int right = (scale_ - image.cols % scale_) % scale_;
    const int bottom = (scale_ - image.rows % scale_) % scale_;
    cv::Mat whole = image;
    if (right + bottom > 0)
      cv::copyMakeBorder(image, whole, 0, bottom, 0, right, cv::BORDER_REPLICATE);
    cv::resize(whole, out, whole.size() / scale_, 0, 0, cv::INTER_AREA);
    cv::GaussianBlur(out, out, {3, 3}, 0.6);
    return out;
  };
  const cv::Mat own = smooth(reference);
  std::vector<cv::Mat> others;
  for (const cv::Mat& image : displaced) others.push_back(smooth(image));
  tbb::enumerable_thread_specific<Strip> strips;
  const int height = own.rows;
  std::vector<std::size_t> gone((height + kStripRows - 1) / kStripRows, 0);
  cv::Mat next(inverse->size(), CV_32FC1), next_weight(inverse->size(), CV_32FC1);
  for (int iteration = 0; iteration < kIterations + scale_ - 1; ++iteration) {
    smoothSurface(*inverse, kNear / widest_, threads_, &next);
    std::swap(*inverse, next);
    parallelFor(0, gone.size(), threads_, [&](std::size_t s) {
      const int begin = static_cast<int>(s) * kStripRows;
      gone[s] += refineStrip(begin, std::min(begin + kStripRows, height), own, others, support,
                             *inverse, *weight, &next, &next_weight, &strips.local());
    });
    std::swap(*inverse, next);
    std::swap(*weight, next_weight);
  }
  std::size_t all = 0;
  for (const std::size_t g : gone) all += g;
  return all;
}

void JointRefinement::raysOf(int y, int width, Strip* strip) const {
  if (scale_ == 1) return rays_.row(y, strip->nodes, strip->rays.data());
  // The ray of a reduced pixel is the mean of those it covers.
  const cv::Size full = geometry_.reference_size;
  strip->full_rays.resize(full.width + 16);
  std::fill(strip->rays.begin(), strip->rays.end(), cv::Vec3f(0, 0, 0));
  for (int v = y * scale_; v < std::min((y + 1) * scale_, full.height); ++v) {
    rays_.row(v, strip->nodes, strip->full_rays.data());
    for (int u = 0; u < full.width; ++u) strip->rays[u / scale_] += strip->full_rays[u];
  }
  for (int x = 0; x < width; ++x) {
    cv::Vec3f& ray = strip->rays[x];
    ray *= 1.0f / std::sqrt(ray.dot(ray));
  }
}

std::size_t JointRefinement::refineStrip(int begin, int end, const cv::Mat& reference,
                                         const std::vector<cv::Mat>& displaced,
                                         const cv::Mat& support, const cv::Mat& inverse,
                                         const cv::Mat& weight, cv::Mat* inverse_out,
                                         cv::Mat* weight_out, Strip* strip) const {
  const int width = reference.cols, height = reference.rows;
  const int rows = end - begin + 4 * kRadius;
  const std::size_t room = static_cast<std::size_t>(rows) * width;
  const std::size_t count = displaced.size();
  strip->images.resize(count);
  for (auto& image : strip->images) {
    for (auto* plane : {&image.grey, &image.slope, &image.there}) plane->assign(room, 0.0f);
    for (auto* plane : {&image.sum, &image.square, &image.count}) plane->resize(room);
  }
  for (auto& plane : strip->d) plane.resize(width);
  for (auto* plane : {&strip->u, &strip->v, &strip->u1, &strip->v1, &strip->value})
    plane->resize(width);
  strip->rays.resize(width + 16);
  for (int r = 0; r < rows; ++r) {
    const int y = begin - 2 * kRadius + r;
    if (y < 0 || y >= height) continue;
    raysOf(y, width, strip);
    const float* w = inverse.ptr<float>(y);
    const std::uint8_t* own = reference.ptr(y);
    for (std::size_t k = 0; k < count; ++k) {
      Strip::Image& image = strip->images[k];
      const auto& camera = geometry_.displaced[k];
      const ProjectionTable& table = tables_[table_of_[k]].table;
      const Eigen::Matrix3f R = camera.T_ref_disp.linear().transpose().cast<float>();
      const Eigen::Vector3f t = R * camera.T_ref_disp.translation().cast<float>();
      const float probe =
          kProbe * static_cast<float>(scale_ / (table.focalPx() * static_cast<double>(t.norm())));
      float* d[6];
      for (int i = 0; i < 6; ++i) d[i] = strip->d[i].data();
      for (int x = 0; x < width; ++x) {
        const cv::Vec3f& ray = strip->rays[x];
        for (int i = 0; i < 3; ++i) {
          const float at = R(i, 0) * ray[0] + R(i, 1) * ray[1] + R(i, 2) * ray[2] - w[x] * t[i];
          d[i][x] = at;
          d[i + 3][x] = at - probe * t[i];
        }
      }
      table.project(d[0], d[1], d[2], width, strip->u.data(), strip->v.data());
      table.project(d[3], d[4], d[5], width, strip->u1.data(), strip->v1.data());
      if (scale_ > 1) {
        // Pixel (0, 0) is the middle of the first pixel, whatever its size.
        const float per = 1.0f / static_cast<float>(scale_);
        for (auto* line : {&strip->u, &strip->v, &strip->u1, &strip->v1})
          for (float& at : *line) at = (at + 0.5f) * per - 0.5f;
      }
      const cv::Mat& other = displaced[k];
      const int step = static_cast<int>(other.step);
      const float right = static_cast<float>(other.cols) - 2.001f;
      const float bottom = static_cast<float>(other.rows) - 2.001f;
      float* grey = &image.grey[static_cast<std::size_t>(r) * width];
      float* slope = &image.slope[static_cast<std::size_t>(r) * width];
      float* there = &image.there[static_cast<std::size_t>(r) * width];
      const auto sample = [&](float u, float v) {
        const int i = static_cast<int>(u), j = static_cast<int>(v);
        const float a = u - static_cast<float>(i), b = v - static_cast<float>(j);
        const std::uint8_t* p = other.data + static_cast<std::ptrdiff_t>(j) * step + i;
        const float top = static_cast<float>(p[0]) + a * static_cast<float>(p[1] - p[0]);
        const float low =
            static_cast<float>(p[step]) + a * static_cast<float>(p[step + 1] - p[step]);
        return top + b * (low - top);
      };
      const float per_probe = 0.5f / probe;
      for (int x = 0; x < width; ++x) {
        const float u = strip->u[x], v = strip->v[x], u1 = strip->u1[x], v1 = strip->v1[x];
        const float u2 = 2 * u - u1, v2 = 2 * v - v1;
        // False where anything is NaN.
        const bool inside = std::min({u, u1, u2}) >= 1.0f && std::min({v, v1, v2}) >= 1.0f &&
                            std::max({u, u1, u2}) <= right && std::max({v, v1, v2}) <= bottom;
        if (!inside || !(u1 == u1)) continue;
        grey[x] = sample(u, v) - static_cast<float>(own[x]);
        slope[x] = (sample(u1, v1) - sample(u2, v2)) * per_probe;
        there[x] = 1.0f;
      }
    }
  }

  // Which positions see a pixel: variance of what the grey values of its window differ by.
  strip->box.resize(room);
  for (auto& image : strip->images) {
    boxSum(image.there, rows, width, width, &strip->line, &image.count);
    boxSum(image.grey, rows, width, width, &strip->line, &image.sum);
    for (std::size_t i = 0; i < room; ++i) strip->box[i] = image.grey[i] * image.grey[i];
    boxSum(strip->box, rows, width, width, &strip->line, &image.square);
  }
  // What the reference itself varies by in the window.
  strip->best.assign(room, kNaN);
  strip->own_sum.resize(room);
  strip->own_square.resize(room);
  for (int r = 0; r < rows; ++r) {
    const std::uint8_t* own = reference.ptr(std::clamp(begin - 2 * kRadius + r, 0, height - 1));
    for (int x = 0; x < width; ++x) {
      const float grey = static_cast<float>(own[x]) - 128.0f;
      strip->own_sum[static_cast<std::size_t>(r) * width + x] = grey;
      strip->own_square[static_cast<std::size_t>(r) * width + x] = grey * grey;
    }
  }
  boxSum(strip->own_sum, rows, width, width, &strip->line, &strip->own_sum);
  boxSum(strip->own_square, rows, width, width, &strip->line, &strip->own_square);
  // Each pixel's part of the normal equations: the mean over the positions that see it taken out,
  // and before that each position's mean over the window, for exposures differ.
  for (auto* plane : {&strip->cross, &strip->slopes, &strip->rest, &strip->known})
    plane->assign(room, 0.0f);
  std::vector<std::pair<float, int>> order(count);
  const int inner = rows - 2 * kRadius;
  for (int r = 0; r < inner; ++r) {
    const int y = begin - kRadius + r;
    if (y < 0 || y >= height) continue;
    const float* w = inverse.ptr<float>(y);
    const std::size_t box = static_cast<std::size_t>(r) * width;
    const std::size_t own = box + static_cast<std::size_t>(kRadius) * width;
    for (int x = 0; x < width; ++x) {
      if (std::isnan(w[x])) continue;
      std::size_t seen = 0;
      for (std::size_t k = 0; k < count; ++k) {
        const Strip::Image& image = strip->images[k];
        const float n = image.count[box + x];
        if (image.there[own + x] == 0 || n < kLeastShare * kWindow * kWindow) continue;
        const float mean = image.sum[box + x] / n;
        order[seen++] = {image.square[box + x] / n - mean * mean, static_cast<int>(k)};
      }
      if (seen == 0) continue;
      std::sort(order.begin(), order.begin() + static_cast<std::ptrdiff_t>(seen));
      const float limit = kUnlike * order[0].first + kNoise;
      strip->best[box + x] = order[0].first;
      float e = 0, g = 0, ee = 0, eg = 0, gg = 0, n = 1;
      for (std::size_t i = 0; i < seen && order[i].first <= limit; ++i) {
        const Strip::Image& image = strip->images[order[i].second];
        const float a = image.grey[own + x] - image.sum[box + x] / image.count[box + x];
        const float b = image.slope[own + x];
        e += a;
        g += b;
        ee += a * a;
        eg += a * b;
        gg += b * b;
        n += 1;
      }
      strip->cross[box + x] = eg - e * g / n;
      strip->slopes[box + x] = gg - g * g / n;
      strip->rest[box + x] = ee - e * e / n;
      strip->known[box + x] = n - 1;
    }
  }
  boxSum(strip->cross, inner, width, width, &strip->line, &strip->cross);
  boxSum(strip->slopes, inner, width, width, &strip->line, &strip->slopes);
  boxSum(strip->rest, inner, width, width, &strip->line, &strip->rest);
  boxSum(strip->known, inner, width, width, &strip->line, &strip->known);

  const float most = kLargestStep / widest_;
  const float prior = widest_ * widest_ / (prior_px_ * prior_px_);
  std::size_t gone = 0;
  for (int y = begin; y < end; ++y) {
    const std::size_t at = static_cast<std::size_t>(y - begin) * width;
    const float* w = inverse.ptr<float>(y);
    const float* w_weight = weight.ptr<float>(y);
    const std::uint8_t* agree = support.ptr(y);
    float* out = inverse_out->ptr<float>(y);
    float* out_weight = weight_out->ptr<float>(y);
    for (int x = 0; x < width; ++x) {
      out[x] = w[x];
      out_weight[x] = w_weight[x];
      const float square = strip->slopes[at + x], known = strip->known[at + x];
      if (std::isnan(w[x]) || !(square > 0) || known < 4) continue;
      // One match alone whose window no position repeats was chance.
      const std::size_t box = at + x + static_cast<std::size_t>(kRadius) * width;
      const float mean = strip->own_sum[box] / (kWindow * kWindow);
      const float own = strip->own_square[box] / (kWindow * kWindow) - mean * mean;
      if (agree[x] < 2 && !(strip->best[box] <= kChance * own + kNoise)) {
        out[x] = kNaN;
        out_weight[x] = 0;
        ++gone;
        continue;
      }
      const float cross = strip->cross[at + x];
      const float variance =
          kDependence *
          (std::max(strip->rest[at + x] - cross * cross / square, 0.0f) / known + 0.1f);
      // What is known before holds windows without texture where they are.
      const float steady = square + variance * prior;
      out[x] += std::clamp(-cross / steady, -most, most);
      out_weight[x] = steady / variance;
    }
  }
  return gone;
}

}  // namespace omnister
