// SPDX-License-Identifier: Apache-2.0
#include "omnister/stereo/thesis_matcher.h"

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <limits>
#include <optional>
#include <string>
#include <vector>

#include "omnister/common/error.h"
#include "omnister/common/numbers.h"
#include "omnister/common/parallel.h"
#include "omnister/stereo/epipolar.h"
#include "omnister/stereo/matching_limits.h"
#include "stereo/geometry/triangulation.h"
#include "stereo/result/range_uncertainty.h"

namespace omnister {
namespace {

constexpr float kNan = std::numeric_limits<float>::quiet_NaN();
constexpr double kMatchSigmaPx = 0.25;

enum Reason { kMasked, kOutsideField, kNoTexture, kUnseen, kAtLimit, kNoParallax, kReasons };
constexpr std::array<const char*, kReasons> kReasonNames = {
    "masked", "outside_field", "no_texture", "unseen", "at_limit", "no_parallax"};

// One pixel of a mask: its place in the dewarped space, (u, v, R0), and its grey level.
struct MaskPixel {
  Eigen::Vector3d dewarped;
  double grey;
};

// The plane family on which a mask is compared: parallel to the image plane or normal to a ray.
struct PlaneFamily {
  Eigen::Vector3d normal;
  Eigen::Vector3d right, down;  // of the dewarped space
};

struct Found {
  double inverse_range;
  double score;
};

// Bilinear; nullopt outside the image.
std::optional<double> greyAt(const cv::Mat& image, const Eigen::Vector2d& pixel) {
  const double u = pixel.x(), v = pixel.y();
  if (!(u >= 0.0 && v >= 0.0 && u <= image.cols - 1.0 && v <= image.rows - 1.0))
    return std::nullopt;
  const int x = std::min(static_cast<int>(u), std::max(image.cols - 2, 0));
  const int y = std::min(static_cast<int>(v), std::max(image.rows - 2, 0));
  const double a = u - x, b = v - y;
  const int right = std::min(x + 1, image.cols - 1);
  const uchar* above = image.ptr<uchar>(y);
  const uchar* below = image.ptr<uchar>(std::min(y + 1, image.rows - 1));
  return (1.0 - b) * ((1.0 - a) * above[x] + a * above[right]) +
         b * ((1.0 - a) * below[x] + a * below[right]);
}

class ThesisMatcher : public Matcher {
 public:
  ThesisMatcher(const StereoGeometry& geometry, const MatcherOptions& options,
                const ThesisOptions& thesis)
      : geometry_(geometry),
        options_(options),
        thesis_(thesis),
        limits_(checkMatching(geometry, options)) {
    if (thesis.window < 3 || thesis.window > 99 || thesis.window % 2 == 0) {
      throw Error("side of the thesis mask is " + std::to_string(thesis.window) +
                  ", expected an odd number from 3 to 99");
    }
    if (!(thesis.object_plane_limit >= 0.0 && thesis.object_plane_limit < M_PI_2)) {
      throw Error("limit of the object plane is " + formatNumber(thesis.object_plane_limit) +
                  " rad, expected 0 to below pi/2");
    }
    options_.mask = options.mask.clone();
    const auto height = geometry.reference_lens->surfaceHeight(0.0, 0.0);
    if (!height || !(*height > 0.0)) throw Error("the reference lens has no height on its axis");
    R0_ = *height;
    const cv::Size size = geometry.reference_size;
    checkMemory(static_cast<double>(size.area()) * sizeof(std::optional<Eigen::Vector3d>),
                "the table of viewing rays");
    rays_.resize(static_cast<std::size_t>(size.area()));
    parallelFor(0, static_cast<std::size_t>(size.height), options_.threads, [&](std::size_t v) {
      for (int u = 0; u < size.width; ++u) {
        rays_[v * size.width + u] = geometry.reference_lens->unproject({u, static_cast<double>(v)});
      }
    });
  }

  MatchResult match(const cv::Mat& reference, const std::vector<cv::Mat>& displaced) override {
    const auto start = std::chrono::steady_clock::now();
    checkImages(geometry_, reference, displaced);
    const cv::Size size = geometry_.reference_size;
    MatchResult result;
    for (cv::Mat* image : {&result.range, &result.sigma, &result.score}) {
      *image = cv::Mat(size, CV_32FC1, cv::Scalar::all(kNan));
    }
    std::vector<std::array<std::size_t, kReasons>> rejected(size.height);
    std::vector<std::size_t> valid(size.height, 0);
    parallelFor(0, static_cast<std::size_t>(size.height), options_.threads, [&](std::size_t row) {
      const int v = static_cast<int>(row);
      rejected[row].fill(0);
      for (int u = 0; u < size.width; ++u) {
        Reason reason = kReasons;
        if (matchPixel(reference, displaced, u, v, result, reason)) {
          ++valid[row];
        } else {
          ++rejected[row][reason];
        }
      }
    });
    for (std::size_t row = 0; row < rejected.size(); ++row) {
      result.statistics.valid += valid[row];
      for (int r = 0; r < kReasons; ++r) {
        result.statistics.rejected[kReasonNames[r]] += rejected[row][r];
      }
    }
    const double seconds =
        std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
    result.statistics.seconds = {{"match", seconds}, {"total", seconds}};
    return result;
  }

 private:
  const std::optional<Eigen::Vector3d>& rayAt(int u, int v) const {
    return rays_[static_cast<std::size_t>(v) * geometry_.reference_size.width + u];
  }

  bool matchPixel(const cv::Mat& reference, const std::vector<cv::Mat>& displaced, int u, int v,
                  MatchResult& result, Reason& reason) const {
    if (!options_.mask.empty() && options_.mask.at<uchar>(v, u) == 0) {
      reason = kMasked;
      return false;
    }
    const auto& ray = rayAt(u, v);
    if (!ray) {
      reason = kOutsideField;
      return false;
    }
    const PlaneFamily planes = planesFor(*ray, u, v);
    const std::vector<MaskPixel> mask = thesis_.mask == ThesisMask::kDistortedPixels
                                            ? distortedMask(reference, u, v, planes)
                                            : dewarpedMask(reference, *ray, planes);
    const std::size_t whole = static_cast<std::size_t>(thesis_.window) * thesis_.window;
    // At the border of image and field the mask is what is left of it, if that is half at least.
    if (2 * mask.size() < whole) {
      reason = kOutsideField;
      return false;
    }
    if (!hasContrast(mask)) {
      reason = kNoTexture;
      return false;
    }
    const auto found = searchPath(displaced, *ray, planes, mask, reason);
    if (!found) return false;
    const auto range = rangeOf(*ray, planes, found->inverse_range);
    const double sigma = sigmaOf(*ray, found->inverse_range);
    if (!range || !(sigma < *range)) {
      reason = kNoParallax;
      return false;
    }
    result.range.at<float>(v, u) = static_cast<float>(*range);
    result.sigma.at<float>(v, u) = static_cast<float>(sigma);
    result.score.at<float>(v, u) = static_cast<float>(std::clamp(found->score, 0.0, 1.0));
    return true;
  }

  // Planes parallel to the image plane where every ray of the mask meets them well, else planes
  // normal to the middle ray.
  PlaneFamily planesFor(const Eigen::Vector3d& ray, int u, int v) const {
    const cv::Size size = geometry_.reference_size;
    const int half = thesis_.window / 2;
    double lowest = ray.z();
    for (int y : {std::max(v - half, 0), v, std::min(v + half, size.height - 1)}) {
      for (int x : {std::max(u - half, 0), u, std::min(u + half, size.width - 1)}) {
        if (const auto& corner = rayAt(x, y)) lowest = std::min(lowest, corner->z());
      }
    }
    if (lowest >= std::cos(thesis_.object_plane_limit)) {
      return {Eigen::Vector3d::UnitZ(), Eigen::Vector3d::UnitX(), Eigen::Vector3d::UnitY()};
    }
    // The ray is far from the z axis here.
    const Eigen::Vector3d along = Eigen::Vector3d::UnitZ().cross(ray).normalized();
    return {ray, along, ray.cross(along)};
  }

  // Eqs 4.17 and 4.18 for planes parallel to the image plane: (R0 x / h, R0 y / h, R0).
  Eigen::Vector3d dewarp(const Eigen::Vector3d& ray, const PlaneFamily& planes) const {
    return R0_ / ray.dot(planes.normal) * ray;
  }

  // Fig. 5.5: distinct pixels of the distorted reference image.
  std::vector<MaskPixel> distortedMask(const cv::Mat& reference, int u, int v,
                                       const PlaneFamily& planes) const {
    const int half = thesis_.window / 2;
    std::vector<MaskPixel> mask;
    for (int y = std::max(v - half, 0); y <= std::min(v + half, reference.rows - 1); ++y) {
      for (int x = std::max(u - half, 0); x <= std::min(u + half, reference.cols - 1); ++x) {
        const auto& ray = rayAt(x, y);
        // A mask wider than a quarter circle (a tiny image) keeps the part that meets the planes.
        if (!ray || ray->dot(planes.normal) < 0.1) continue;
        mask.push_back({dewarp(*ray, planes), static_cast<double>(reference.at<uchar>(y, x))});
      }
    }
    return mask;
  }

  // Fig. 5.4: a square of the dewarped space, projected into the reference image.
  std::vector<MaskPixel> dewarpedMask(const cv::Mat& reference, const Eigen::Vector3d& ray,
                                      const PlaneFamily& planes) const {
    const int half = thesis_.window / 2;
    const Eigen::Vector3d middle = dewarp(ray, planes);
    std::vector<MaskPixel> mask;
    for (int j = -half; j <= half; ++j) {
      for (int i = -half; i <= half; ++i) {
        const Eigen::Vector3d dewarped = middle + i * planes.right + j * planes.down;
        const auto pixel = geometry_.reference_lens->project(dewarped);
        const auto grey = pixel ? greyAt(reference, *pixel) : std::nullopt;
        if (grey) mask.push_back({dewarped, *grey});
      }
    }
    return mask;
  }

  bool hasContrast(const std::vector<MaskPixel>& mask) const {
    double sum = 0.0, squares = 0.0;
    for (const MaskPixel& pixel : mask) {
      sum += pixel.grey;
      squares += pixel.grey * pixel.grey;
    }
    const double mean = sum / mask.size();
    return squares / mask.size() - mean * mean >= thesis_.min_contrast * thesis_.min_contrast;
  }

  // Eq. 3.1 between the mask and where it lies in a displaced image, for planes at distance R0 /
  // scale; nullopt unless the whole mask lies inside that image.
  std::optional<double> correlation(const cv::Mat& image, const StereoGeometry::Displaced& camera,
                                    const std::vector<MaskPixel>& mask, double scale) const {
    const Eigen::Vector3d shift = scale * camera.T_ref_disp.translation();
    const Eigen::Matrix3d R_disp_ref = camera.T_ref_disp.linear().transpose();
    double ab = 0.0, aa = 0.0, bb = 0.0;
    for (const MaskPixel& pixel : mask) {
      const auto place = camera.lens->project(R_disp_ref * (pixel.dewarped - shift));
      const auto grey = place ? greyAt(image, *place) : std::nullopt;
      if (!grey) return std::nullopt;
      ab += pixel.grey * *grey;
      aa += pixel.grey * pixel.grey;
      bb += *grey * *grey;
    }
    if (!(aa > 0.0) || !(bb > 0.0)) return 0.0;
    return ab / std::sqrt(aa * bb);
  }

  // Candidates so that none is more than a pixel from the next in any displaced image.
  int candidateCount(const Eigen::Vector3d& ray) const {
    constexpr int kProbes = 9;
    const double span = limits_.maxInverseRange() - limits_.minInverseRange();
    double speed = 0.0;
    for (const auto& camera : geometry_.displaced) {
      const EpipolarCurve curve(ray, camera.T_ref_disp, *camera.lens);
      for (int i = 0; i < kProbes; ++i) {
        const double w = limits_.minInverseRange() + span * i / (kProbes - 1);
        const auto here = curve.pixel(w);
        const auto next = curve.pixel(w + 1e-4 * span);
        if (here && next) speed = std::max(speed, (*next - *here).norm() / 1e-4);
      }
    }
    // At least as many as a parabola needs, with one step to each side.
    return static_cast<int>(
        std::min(std::ceil(std::max(speed, 4.0)) + 1.0, static_cast<double>(limits_.hypotheses)));
  }

  std::optional<Found> searchPath(const std::vector<cv::Mat>& displaced, const Eigen::Vector3d& ray,
                                  const PlaneFamily& planes, const std::vector<MaskPixel>& mask,
                                  Reason& reason) const {
    const int count = candidateCount(ray);
    const double first = limits_.minInverseRange();
    const double step = (limits_.maxInverseRange() - first) / (count - 1);
    // A point at range 1 / w on the middle ray lies on the plane at distance (ray . normal) / w.
    const double scale_per_w = R0_ / ray.dot(planes.normal);
    std::vector<std::optional<double>> scores(count);
    int best = -1;
    for (int k = 0; k < count; ++k) {
      const double scale = scale_per_w * (first + k * step);
      double sum = 0.0;
      int seen = 0;
      for (std::size_t i = 0; i < displaced.size(); ++i) {
        if (const auto c = correlation(displaced[i], geometry_.displaced[i], mask, scale)) {
          sum += *c;
          ++seen;
        }
      }
      if (seen == 0) continue;
      scores[k] = sum / seen;
      if (best < 0 || *scores[k] > *scores[best]) best = k;
    }
    if (best < 0) {
      reason = kUnseen;
      return std::nullopt;
    }
    if (best == 0 || best == count - 1 || !scores[best - 1] || !scores[best + 1]) {
      reason = kAtLimit;
      return std::nullopt;
    }
    double offset = 0.0;
    if (thesis_.subpixel) {
      const double before = *scores[best - 1], here = *scores[best], after = *scores[best + 1];
      const double curvature = before - 2.0 * here + after;
      if (curvature < 0.0) offset = std::clamp(0.5 * (before - after) / curvature, -0.5, 0.5);
    }
    return Found{first + (best + offset) * step, *scores[best]};
  }

  // Range along the reference ray from the matched place in the displaced image of most parallax.
  std::optional<double> rangeOf(const Eigen::Vector3d& ray, const PlaneFamily& planes,
                                double inverse_range) const {
    const auto parallax = [&](const StereoGeometry::Displaced& camera) {
      return EpipolarCurve(ray, camera.T_ref_disp, *camera.lens).parallax(inverse_range);
    };
    const auto& camera =
        *std::max_element(geometry_.displaced.begin(), geometry_.displaced.end(),
                          [&](const auto& a, const auto& b) { return parallax(a) < parallax(b); });
    const Eigen::Vector3d t = camera.T_ref_disp.translation();
    const bool sideways =
        camera.T_ref_disp.linear().isIdentity(1e-12) && t.y() == 0.0 && t.z() == 0.0;
    if (sideways && planes.normal == Eigen::Vector3d::UnitZ()) {
      const Eigen::Vector3d dewarped = dewarp(ray, planes);
      const double n = -R0_ / ray.z() * inverse_range * t.x();
      const auto depth = depthFromDisparity(R0_, -t.x(), n);
      if (!depth) return std::nullopt;
      return *depth / R0_ * dewarped.norm();
    }
    const EpipolarCurve curve(ray, camera.T_ref_disp, *camera.lens);
    const auto point = triangulate(ray, curve.bearing(inverse_range), camera.T_ref_disp);
    if (!point) return std::nullopt;
    return point->range_first;
  }

  double sigmaOf(const Eigen::Vector3d& ray, double inverse_range) const {
    const double step = 1e-5 * limits_.maxInverseRange();
    double squares = 0.0;
    for (const auto& camera : geometry_.displaced) {
      const EpipolarCurve curve(ray, camera.T_ref_disp, *camera.lens);
      const auto here = curve.pixel(inverse_range);
      const auto next = curve.pixel(inverse_range + step);
      if (here && next) squares += (*next - *here).squaredNorm() / (step * step);
    }
    // d(range) = range^2 d(w)
    return kMatchSigmaPx / std::sqrt(squares) / (inverse_range * inverse_range);
  }

  StereoGeometry geometry_;
  MatcherOptions options_;
  ThesisOptions thesis_;
  MatchingLimits limits_;
  double R0_ = 0.0;
  std::vector<std::optional<Eigen::Vector3d>> rays_;
};

}  // namespace

ThesisMask parseThesisMask(std::string_view name) {
  if (name == "fig5.4") return ThesisMask::kDewarpedSquare;
  if (name == "fig5.5") return ThesisMask::kDistortedPixels;
  throw Error("unknown thesis mask '" + printable(name) + "', expected fig5.4 or fig5.5");
}

std::unique_ptr<Matcher> makeThesisMatcher(const StereoGeometry& geometry,
                                           const MatcherOptions& options,
                                           const ThesisOptions& thesis) {
  return withCalibrationSigma(std::make_unique<ThesisMatcher>(geometry, options, thesis), geometry,
                              options);
}

}  // namespace omnister
