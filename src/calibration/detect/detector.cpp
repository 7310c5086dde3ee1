// SPDX-License-Identifier: Apache-2.0
#include "omnister/calibration/detector.h"

#include <algorithm>
#include <cstdint>
#include <exception>
#include <opencv2/core.hpp>

#include "calibration/detect/board_detectors.h"
#include "omnister/common/error.h"
#include "omnister/common/image_file.h"
#include "omnister/common/parallel.h"

namespace omnister {
namespace {

// OpenCV's detectors search with random trees drawn from a generator that each thread carries
// along: seeded here, what is found in an image does not depend on the images that its thread saw
// before.
class SameRandomness {
 public:
  SameRandomness() : state_(cv::theRNG().state) { cv::theRNG().state = 0x9E3779B97F4A7C15ull; }
  ~SameRandomness() { cv::theRNG().state = state_; }
  SameRandomness(const SameRandomness&) = delete;
  SameRandomness& operator=(const SameRandomness&) = delete;

 private:
  std::uint64_t state_;
};

std::vector<detect::Corner> detectCorners(const detect::GrayImage& image, const Target& target,
                                          const detect::Budget& budget) {
  switch (target.type) {
    case TargetType::kCheckerboard:
      return detect::detectCheckerboard(image, target, budget);
    case TargetType::kCircles:
      return detect::detectCircles(image, target, budget);
    case TargetType::kCharuco:
      return detect::detectCharuco(image, target, budget);
    case TargetType::kAprilGrid:
      return detect::detectAprilGrid(image, target, budget);
  }
  return {};
}

}  // namespace

std::optional<ViewDetections> detectTarget(const cv::Mat& image, const Target& target,
                                           const DetectorOptions& options) {
  checkTarget(target, "target");
  const detect::GrayImage gray = detect::toGray(image);
  // Smaller than any board that could be told from noise: three pixels a point.
  const Eigen::Vector2i grid = targetGrid(target);
  const int smallest = 3 * std::min(grid.x(), grid.y());
  if (gray.eight_bit.cols < smallest || gray.eight_bit.rows < smallest) return std::nullopt;
  const SameRandomness same;
  const std::vector<detect::Corner> corners =
      detectCorners(gray, target, detect::Budget(options.seconds_per_image));
  if (corners.empty()) return std::nullopt;
  const std::vector<Eigen::Vector3d> points = targetPoints(target);
  ViewDetections view;
  for (const detect::Corner& corner : corners) {
    view.pixels.push_back(corner.pixel);
    view.points.push_back(points[corner.id]);
  }
  return view;
}

Detections detectInFiles(const std::vector<std::string>& image_files, const Target& target,
                         const DetectorOptions& options, std::vector<std::string>* missed,
                         const Progress& progress) {
  checkTarget(target, "target");
  struct Outcome {
    cv::Size size;
    std::optional<ViewDetections> view;
    std::exception_ptr error;
  };
  std::vector<Outcome> outcomes(image_files.size());
  // In rounds, because progress is told from this thread; long enough that no core waits much.
  const std::size_t round = 4 * static_cast<std::size_t>(threadCount(options.threads));
  for (std::size_t begin = 0; begin < image_files.size(); begin += round) {
    if (progress) {
      progress(static_cast<double>(begin) / image_files.size(), "detecting corners");
    }
    const std::size_t end = std::min(begin + round, image_files.size());
    parallelFor(begin, end, options.threads, [&](std::size_t i) {
      try {
        const cv::Mat image = readImage(image_files[i], ImageColor::kGray);
        outcomes[i].size = image.size();
        outcomes[i].view = detectTarget(image, target, options);
      } catch (const cv::Exception& error) {
        outcomes[i].error = std::make_exception_ptr(
            InputError(image_files[i], "", "cannot be searched for the target: " + error.err));
      } catch (...) {
        outcomes[i].error = std::current_exception();
      }
    });
    // The first bad file in the order given, whichever thread came upon it.
    for (std::size_t i = begin; i < end; ++i) {
      if (outcomes[i].error) std::rethrow_exception(outcomes[i].error);
      if (outcomes[i].size != outcomes[0].size) {
        const auto text = [](const cv::Size& size) {
          return std::to_string(size.width) + "x" + std::to_string(size.height);
        };
        throw InputError(image_files[i], "",
                         "is " + text(outcomes[i].size) + " pixels, expected " +
                             text(outcomes[0].size) + " as " + image_files[0]);
      }
    }
  }
  Detections detections;
  if (!outcomes.empty()) detections.image_size = outcomes[0].size;
  for (std::size_t i = 0; i < outcomes.size(); ++i) {
    if (outcomes[i].view) {
      outcomes[i].view->name = image_files[i];
      detections.views.push_back(std::move(*outcomes[i].view));
    } else if (missed != nullptr) {
      missed->push_back(image_files[i]);
    }
  }
  if (progress) progress(1.0, "detecting corners");
  return detections;
}

}  // namespace omnister
