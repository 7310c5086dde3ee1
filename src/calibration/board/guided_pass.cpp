// SPDX-License-Identifier: Apache-2.0
#include "omnister/calibration/guided_pass.h"

#include <algorithm>
#include <cmath>
#include <exception>
#include <opencv2/core.hpp>

#include "calibration/fit/fit.h"
#include "omnister/common/error.h"
#include "omnister/common/image_file.h"
#include "omnister/common/parallel.h"
#include "omnister/view/view.h"

namespace omnister {

namespace {

constexpr double kPi = 3.14159265358979323846;
constexpr double kViewField = 100.0 * kPi / 180.0;  ///< of a virtual view, across
constexpr int kLargestView = 1000;                  ///< [px]
/// Narrower lenses show boards straight already.
constexpr double kNarrow = 0.6;  // [rad]

struct VirtualView {
  ViewGeometry geometry;
  View view;
};

/// One view ahead and a ring of them that reaches to the edge of the field.
std::vector<VirtualView> virtualViews(const LensModel& lens, cv::Size size) {
  std::vector<Eigen::Matrix3d> turns = {Eigen::Matrix3d::Identity()};
  const double edge = lens.maxTheta();
  const double off_axis = std::max(edge - 0.35 * kViewField, 0.5 * edge);
  constexpr int kRing = 6;
  for (int i = 0; i < kRing; ++i) {
    turns.push_back(omniviewRotation(off_axis, 2.0 * kPi * i / kRing, 0.0));
  }
  // As fine as the lens is on its axis, where views and images are alike.
  const double across = 2.0 * std::tan(0.5 * kViewField) * calibration::focalLength(lens);
  const int side = std::clamp(static_cast<int>(across), 200, kLargestView);
  std::vector<VirtualView> views;
  for (const Eigen::Matrix3d& turn : turns) {
    const ViewGeometry geometry =
        makeViewGeometry(Projection::kPinhole, {side, side}, kViewField, turn);
    views.push_back({geometry, View(lens, size, geometry, true, 1)});
  }
  return views;
}

/// The target in whichever virtual view shows most of it; pixels are those of the image.
std::optional<ViewDetections> findInViews(const cv::Mat& image, const Target& target,
                                          const LensModel& lens,
                                          const std::vector<VirtualView>& views,
                                          const DetectorOptions& options) {
  DetectorOptions bounded = options;
  bounded.threads = 1;
  bounded.seconds_per_image = options.seconds_per_image / static_cast<double>(views.size());
  std::optional<ViewDetections> best;
  const std::size_t complete = targetPoints(target).size();
  for (const VirtualView& virtual_view : views) {
    const auto seen = detectTarget(virtual_view.view.render(image), target, bounded);
    if (!seen) continue;
    ViewDetections found;
    for (std::size_t i = 0; i < seen->pixels.size(); ++i) {
      const auto ray = viewRay(virtual_view.geometry, seen->pixels[i]);
      const auto pixel = ray ? lens.project(*ray) : std::nullopt;
      if (!pixel || !(pixel->minCoeff() > 0.0) || !(pixel->x() < image.cols - 1) ||
          !(pixel->y() < image.rows - 1)) {
        continue;
      }
      found.pixels.push_back(*pixel);
      found.points.push_back(seen->points[i]);
    }
    if (found.pixels.size() < 4) continue;
    if (!best || found.pixels.size() > best->pixels.size()) best = std::move(found);
    if (best->pixels.size() == complete) break;
  }
  return best;
}

}  // namespace

GuidedPass detectGuided(const std::vector<std::string>& image_files, const Target& target,
                        const LensModel& lens, const Detections& first,
                        const DetectorOptions& options, const Progress& progress) {
  struct Outcome {
    std::optional<ViewDetections> view;
    std::exception_ptr error;
  };
  std::vector<const ViewDetections*> known(image_files.size(), nullptr);
  std::size_t next = 0;
  for (std::size_t i = 0; i < image_files.size() && next < first.views.size(); ++i) {
    if (first.views[next].name == image_files[i]) known[i] = &first.views[next++];
  }
  if (next != first.views.size()) throw Error("the detected views are not those of the images");
  const std::vector<VirtualView> views =
      lens.maxTheta() > kNarrow ? virtualViews(lens, first.image_size) : std::vector<VirtualView>();

  std::vector<Outcome> outcomes(image_files.size());
  const std::size_t round = 4 * static_cast<std::size_t>(threadCount(options.threads));
  for (std::size_t begin = 0; begin < image_files.size(); begin += round) {
    if (progress) {
      progress(static_cast<double>(begin) / image_files.size(), "detecting with the first lens");
    }
    const std::size_t end = std::min(begin + round, image_files.size());
    parallelFor(begin, end, options.threads, [&](std::size_t i) {
      try {
        const cv::Mat image = readImage(image_files[i], ImageColor::kGray);
        std::optional<ViewDetections> start;
        if (known[i] != nullptr) {
          start = *known[i];
        } else if (image.size() == first.image_size) {
          start = findInViews(image, target, lens, views, options);
        }
        if (!start) return;
        start->name = image_files[i];
        outcomes[i].view =
            start->pixels.size() < 4 ? *start : refineGuided(image, target, lens, *start);
      } catch (...) {
        outcomes[i].error = std::current_exception();
      }
    });
  }
  GuidedPass pass;
  pass.detections.image_size = first.image_size;
  for (std::size_t i = 0; i < outcomes.size(); ++i) {
    if (outcomes[i].error) std::rethrow_exception(outcomes[i].error);
    if (known[i] != nullptr) pass.corners_before += static_cast<int>(known[i]->pixels.size());
    if (!outcomes[i].view) {
      pass.missed.push_back(image_files[i]);
      continue;
    }
    pass.views_added += known[i] == nullptr ? 1 : 0;
    pass.corners_after += static_cast<int>(outcomes[i].view->pixels.size());
    if (known[i] != nullptr) outcomes[i].view->stage = known[i]->stage;
    pass.detections.views.push_back(std::move(*outcomes[i].view));
  }
  if (progress) progress(1.0, "detecting with the first lens");
  return pass;
}

namespace {

/// Noise of what is fitted to these corners.
double noiseOf(const std::vector<const CalibrationResult*>& cameras) {
  std::vector<std::vector<Eigen::Vector2d>> residuals;
  int points = 0;
  for (const CalibrationResult* camera : cameras) {
    points += camera->points;
    for (const ViewResult& view : camera->views) {
      if (view.used) residuals.push_back(view.residuals);
    }
  }
  return calibration::statisticsOf(residuals).sigma_px / std::sqrt(std::max(1, points));
}

}  // namespace

bool servesBetter(const CalibrationResult& first, const CalibrationResult& second) {
  return noiseOf({&second}) < noiseOf({&first}) && second.rms_px <= 1.15 * first.rms_px;
}

bool servesBetter(const StereoCalibrationResult& first, const StereoCalibrationResult& second) {
  return noiseOf({&second.left, &second.right}) < noiseOf({&first.left, &first.right}) &&
         second.rms_px <= 1.15 * first.rms_px;
}

}  // namespace omnister
