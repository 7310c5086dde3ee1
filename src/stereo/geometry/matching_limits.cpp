// SPDX-License-Identifier: Apache-2.0
#include "omnister/stereo/matching_limits.h"

#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <opencv2/core.hpp>
#include <string>

#include "omnister/common/error.h"
#include "omnister/common/numbers.h"
#include "omnister/stereo/epipolar.h"

namespace omnister {
namespace {

std::string sizeText(cv::Size size) {
  return std::to_string(size.width) + "x" + std::to_string(size.height);
}

std::string displacedName(std::size_t index) {
  return "displaced camera " + std::to_string(index + 1);
}

void checkSize(cv::Size size, const std::string& whose) {
  if (size.width < 1 || size.height < 1 || size.width > kMaxImageSide ||
      size.height > kMaxImageSide) {
    throw Error("size of the " + whose + " is " + sizeText(size) + ", expected 1 to " +
                std::to_string(kMaxImageSide) + " pixels each way");
  }
}

void checkPose(const Pose& pose, const std::string& whose) {
  if (!pose.matrix().allFinite()) throw Error("pose of " + whose + " is not finite");
  const Eigen::Matrix3d R = pose.linear();
  if ((R.transpose() * R - Eigen::Matrix3d::Identity()).norm() > 1e-6 || R.determinant() < 0.0) {
    throw Error("pose of " + whose + " is not a rigid motion");
  }
  // A micrometre is below what any stage or calibration knows.
  if (pose.translation().norm() < 1e-6) {
    throw Error(whose + " stands where the reference camera stands (baseline " +
                formatNumber(pose.translation().norm()) + " m): there is no parallax to match by");
  }
}

// Length of an epipolar path inside the displaced image [px]; negative when none of it is.
double pathLength(const EpipolarCurve& curve, double w_begin, double w_end, cv::Size size) {
  constexpr int kSteps = 32;
  const double first = curve.parallax(w_begin);
  const double last = curve.parallax(w_end);
  double length = -1.0;
  Eigen::Vector2d previous = Eigen::Vector2d::Zero();
  bool connected = false;
  for (int i = 0; i <= kSteps; ++i) {
    const double parallax = first + (last - first) * i / kSteps;
    const double w = i == 0 ? w_begin : i == kSteps ? w_end : curve.inverseRange(parallax);
    const auto pixel = std::isfinite(w) ? curve.pixel(w) : std::nullopt;
    const bool inside = pixel && pixel->x() >= 0.0 && pixel->y() >= 0.0 &&
                        pixel->x() <= size.width - 1.0 && pixel->y() <= size.height - 1.0;
    if (inside) {
      length = std::max(length, 0.0);
      if (connected) length += (*pixel - previous).norm();
      previous = *pixel;
    }
    connected = inside;
  }
  return length;
}

double longestPath(const StereoGeometry& geometry, double w_begin, double w_end) {
  constexpr int kColumns = 24;
  constexpr int kRows = 18;
  double longest = -1.0;
  for (int j = 0; j < kRows; ++j) {
    for (int i = 0; i < kColumns; ++i) {
      const Eigen::Vector2d pixel((i + 0.5) / kColumns * geometry.reference_size.width - 0.5,
                                  (j + 0.5) / kRows * geometry.reference_size.height - 0.5);
      const auto ray = geometry.reference_lens->unproject(pixel);
      if (!ray) continue;
      for (const auto& displaced : geometry.displaced) {
        const EpipolarCurve curve(*ray, displaced.T_ref_disp, *displaced.lens);
        longest = std::max(longest, pathLength(curve, w_begin, w_end, displaced.size));
      }
    }
  }
  return longest;
}

}  // namespace

void checkPrior(const StereoGeometry& geometry, const cv::Mat& prior) {
  if (prior.empty() || (prior.type() == CV_32FC1 && prior.size() == geometry.reference_size))
    return;
  throw Error("prior range is " + sizeText(prior.size()) +
              ", expected one 32-bit float channel of " + sizeText(geometry.reference_size) +
              " like the reference image");
}

MatchingLimits checkMatching(const StereoGeometry& geometry, const MatcherOptions& options) {
  if (!geometry.reference_lens) throw Error("the reference camera has no lens");
  checkSize(geometry.reference_size, "reference image");
  if (geometry.displaced.empty()) throw Error("no displaced camera given, expected at least one");
  MatchingLimits limits;
  for (std::size_t i = 0; i < geometry.displaced.size(); ++i) {
    const auto& displaced = geometry.displaced[i];
    if (!displaced.lens) throw Error(displacedName(i) + " has no lens");
    checkSize(displaced.size, "image of " + displacedName(i));
    checkPose(displaced.T_ref_disp, displacedName(i));
    limits.longest_baseline =
        std::max(limits.longest_baseline, displaced.T_ref_disp.translation().norm());
  }

  if (!std::isfinite(options.min_range) || options.min_range < 0.0) {
    throw Error("minimum range is " + formatNumber(options.min_range) +
                " m, expected a positive number, or 0 for four baselines");
  }
  if (std::isnan(options.max_range) || options.max_range < 0.0) {
    throw Error("maximum range is " + formatNumber(options.max_range) +
                " m, expected a positive number, or 0 for no limit");
  }
  // A parallax of atan(1/4) straight across the baseline.
  limits.min_range = options.min_range > 0.0 ? options.min_range : 4.0 * limits.longest_baseline;
  limits.max_range =
      options.max_range > 0.0 ? options.max_range : std::numeric_limits<double>::infinity();
  if (!(limits.min_range < limits.max_range)) {
    throw Error("minimum range " + formatNumber(limits.min_range) + " m" +
                (options.min_range > 0.0 ? "" : " (four baselines, since none was given)") +
                " is not below the maximum range " + formatNumber(limits.max_range) + " m");
  }
  if (!std::isfinite(limits.maxInverseRange())) {
    throw Error("minimum range " + formatNumber(limits.min_range) + " m is too small");
  }

  if (options.hypotheses < 0 || options.hypotheses == 1 || options.hypotheses > kMaxHypotheses) {
    throw Error("number of hypotheses is " + std::to_string(options.hypotheses) +
                ", expected 2 to " + std::to_string(kMaxHypotheses) +
                ", or 0 for one a pixel of parallax");
  }
  if (options.threads < 0 || options.threads > kMaxThreads) {
    throw Error("number of threads is " + std::to_string(options.threads) + ", expected 0 to " +
                std::to_string(kMaxThreads));
  }
  if (!options.mask.empty() &&
      (options.mask.type() != CV_8UC1 || options.mask.size() != geometry.reference_size)) {
    throw Error("mask is " + sizeText(options.mask.size()) + " with " +
                std::to_string(options.mask.channels()) +
                " channel(s), expected one 8-bit channel of " + sizeText(geometry.reference_size) +
                " like the reference image");
  }

  checkPrior(geometry, options.prior);

  limits.longest_path_px =
      longestPath(geometry, limits.minInverseRange(), limits.maxInverseRange());
  if (limits.longest_path_px < 0.0) {
    throw Error("the displaced cameras see nothing of what the reference camera sees between " +
                formatNumber(limits.min_range) + " m and " + formatNumber(limits.max_range) + " m");
  }
  if (limits.longest_path_px < 0.1) {
    throw Error("parallax between " + formatNumber(limits.min_range) + " m and " +
                formatNumber(limits.max_range) + " m is only " +
                formatNumber(limits.longest_path_px) +
                " px: the baseline is too short, or the range limits are too narrow");
  }
  limits.hypotheses = options.hypotheses > 0
                          ? options.hypotheses
                          : static_cast<int>(std::clamp(std::ceil(limits.longest_path_px) + 1.0,
                                                        2.0, static_cast<double>(kMaxHypotheses)));
  return limits;
}

void checkMemory(double bytes, std::string_view what) {
  const double machine =
      static_cast<double>(::sysconf(_SC_PHYS_PAGES)) * static_cast<double>(::sysconf(_SC_PAGESIZE));
  if (bytes > 0.5 * machine) {
    throw Error(std::string(what) + " would take " + formatNumber(std::ceil(bytes / 1048576.0)) +
                " MiB, more than half of this machine's memory");
  }
}

void checkImages(const StereoGeometry& geometry, const cv::Mat& reference,
                 const std::vector<cv::Mat>& displaced) {
  const auto check = [](const cv::Mat& image, cv::Size size, const std::string& whose) {
    if (image.size() != size || image.type() != CV_8UC1) {
      throw Error(whose + " is " + sizeText(image.size()) + " with " +
                  std::to_string(image.channels()) + " channel(s), expected one 8-bit channel of " +
                  sizeText(size));
    }
  };
  check(reference, geometry.reference_size, "reference image");
  if (displaced.size() != geometry.displaced.size()) {
    throw Error(std::to_string(displaced.size()) + " displaced image(s) for " +
                std::to_string(geometry.displaced.size()) + " displaced camera(s)");
  }
  for (std::size_t i = 0; i < displaced.size(); ++i) {
    check(displaced[i], geometry.displaced[i].size, "image of " + displacedName(i));
  }
}

std::vector<std::string> imageRemarks(const cv::Mat& reference,
                                      const std::vector<cv::Mat>& displaced) {
  std::vector<std::string> remarks;
  double reference_mean = 0.0;
  for (std::size_t i = 0; i <= displaced.size(); ++i) {
    const cv::Mat& image = i == 0 ? reference : displaced[i - 1];
    const std::string whose =
        i == 0 ? "the reference image" : "displaced image " + std::to_string(i);
    cv::Scalar mean, spread;
    cv::meanStdDev(image, mean, spread);
    const double saturated =
        static_cast<double>(cv::countNonZero(image == 255)) / static_cast<double>(image.total());
    if (mean[0] < 2.0) {
      remarks.push_back(whose + " is black");
    } else if (saturated > 0.5) {
      remarks.push_back(whose + " is saturated: " + formatNumber(std::round(100.0 * saturated)) +
                        " % of it");
    } else if (spread[0] < 1.0) {
      remarks.push_back(whose + " has no contrast");
    } else if (i > 0 && reference_mean >= 2.0 &&
               (mean[0] > 3.0 * reference_mean || 3.0 * mean[0] < reference_mean)) {
      remarks.push_back(whose + " is exposed otherwise than the reference: mean grey level " +
                        formatNumber(std::round(mean[0])) + " to " +
                        formatNumber(std::round(reference_mean)));
    }
    if (i == 0) reference_mean = mean[0];
  }
  return remarks;
}

}  // namespace omnister
