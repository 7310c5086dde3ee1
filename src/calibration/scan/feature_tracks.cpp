// SPDX-License-Identifier: Apache-2.0
#include "omnister/calibration/feature_tracks.h"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <opencv2/features2d.hpp>
#include <opencv2/imgproc.hpp>
#include <opencv2/video/tracking.hpp>
#include <optional>
#include <string>

#include "calibration/scan/picture_mask.h"
#include "omnister/common/error.h"
#include "omnister/common/parallel.h"

namespace omnister {
namespace {

constexpr int kPyramidLevels = 4;
const cv::Size kWindow(13, 13);
const cv::TermCriteria kConverged(cv::TermCriteria::COUNT | cv::TermCriteria::EPS, 40, 0.003);
/// A point followed forth and back must come home this near [px].
constexpr float kRoundTripPx = 0.25f;
/// Lowe's ratio of the best to the second-best descriptor distance.
constexpr float kRatio = 0.8f;

cv::Mat gray(const cv::Mat& image) {
  if (image.channels() == 1) return image;
  cv::Mat result;
  cv::cvtColor(image, result, cv::COLOR_BGR2GRAY);
  return result;
}

struct ScanFeatures {
  std::vector<cv::KeyPoint> keypoints;
  cv::Mat descriptors;
  std::vector<std::vector<std::optional<cv::Point2f>>> pixels;  // [feature][image]
};

/// The strongest SIFT keypoints of every cell that are corners too: Lucas-Kanade cannot hold a blob
/// on a straight edge.
std::vector<cv::KeyPoint> spreadKeypoints(const cv::Mat& image, const cv::Mat1b& inside,
                                          int wanted) {
  std::vector<cv::KeyPoint> all;
  cv::SIFT::create(0, 3, 0.02)->detect(image, all, inside);
  cv::Mat corners;
  cv::cornerMinEigenVal(image, corners, 7);
  double strongest = 0.0;
  cv::minMaxLoc(corners, nullptr, &strongest, nullptr, nullptr, inside);
  const auto cornerness = [&](const cv::KeyPoint& k) {
    return corners.at<float>(std::clamp(cvRound(k.pt.y), 0, image.rows - 1),
                             std::clamp(cvRound(k.pt.x), 0, image.cols - 1));
  };
  all.erase(std::remove_if(all.begin(), all.end(),
                           [&](const cv::KeyPoint& k) { return cornerness(k) < 2e-3 * strongest; }),
            all.end());
  const double cell = std::sqrt(static_cast<double>(image.total()) / std::max(1, wanted / 4));
  const int columns = std::max(1, static_cast<int>(std::ceil(image.cols / cell)));
  const int rows = std::max(1, static_cast<int>(std::ceil(image.rows / cell)));
  std::vector<std::vector<cv::KeyPoint>> cells(static_cast<std::size_t>(columns) * rows);
  for (const cv::KeyPoint& k : all) {
    const int c = std::min(columns - 1, static_cast<int>(k.pt.x / cell));
    const int r = std::min(rows - 1, static_cast<int>(k.pt.y / cell));
    cells[static_cast<std::size_t>(r) * columns + c].push_back(k);
  }
  std::vector<cv::KeyPoint> chosen;
  for (auto& group : cells) {
    std::sort(group.begin(), group.end(), [&](const cv::KeyPoint& a, const cv::KeyPoint& b) {
      return cornerness(a) > cornerness(b);
    });
    std::vector<cv::KeyPoint> kept;
    for (const cv::KeyPoint& k : group) {
      // SIFT names one place several times, once an orientation.
      const bool near = std::any_of(kept.begin(), kept.end(), [&](const cv::KeyPoint& other) {
        return cv::norm(other.pt - k.pt) < 4.0;
      });
      if (!near) kept.push_back(k);
      if (kept.size() == 4) break;
    }
    chosen.insert(chosen.end(), kept.begin(), kept.end());
  }
  return chosen;
}

/// Follows `points` of `reference` into `image`, starting from `guess`. Points that were lost get
/// no value.
std::vector<std::optional<cv::Point2f>> follow(const std::vector<cv::Mat>& reference,
                                               const std::vector<cv::Mat>& image,
                                               const std::vector<cv::Point2f>& points,
                                               std::vector<cv::Point2f> guess) {
  std::vector<std::optional<cv::Point2f>> found(points.size());
  if (points.empty()) return found;
  std::vector<unsigned char> forth, back;
  std::vector<float> error;
  cv::calcOpticalFlowPyrLK(reference, image, points, guess, forth, error, kWindow, kPyramidLevels,
                           kConverged, cv::OPTFLOW_USE_INITIAL_FLOW, 1e-4);
  std::vector<cv::Point2f> home = points;
  cv::calcOpticalFlowPyrLK(image, reference, guess, home, back, error, kWindow, kPyramidLevels,
                           kConverged, cv::OPTFLOW_USE_INITIAL_FLOW, 1e-4);
  const cv::Rect2f inside(0.0f, 0.0f, static_cast<float>(image[0].cols - 1),
                          static_cast<float>(image[0].rows - 1));
  for (std::size_t i = 0; i < points.size(); ++i) {
    if (forth[i] && back[i] && inside.contains(guess[i]) &&
        cv::norm(home[i] - points[i]) < kRoundTripPx) {
      found[i] = guess[i];
    }
  }
  return found;
}

ScanFeatures trackScan(const StageScan& scan, const cv::Mat1b& inside, int wanted) {
  const std::size_t count = scan.images.size();
  std::vector<std::size_t> order(count);
  std::iota(order.begin(), order.end(), std::size_t{0});
  std::sort(order.begin(), order.end(), [&](std::size_t a, std::size_t b) {
    return scan.positions_m[a] < scan.positions_m[b];
  });
  const std::size_t middle = count / 2;

  std::vector<std::vector<cv::Mat>> pyramids(count);
  for (std::size_t i = 0; i < count; ++i) {
    cv::buildOpticalFlowPyramid(gray(scan.images[i]), pyramids[i], kWindow, kPyramidLevels);
  }
  const cv::Mat reference = gray(scan.images[order[middle]]);

  ScanFeatures features;
  features.keypoints = spreadKeypoints(reference, inside, wanted);
  if (!features.keypoints.empty()) {
    cv::SIFT::create()->compute(reference, features.keypoints, features.descriptors);
  }
  std::vector<cv::Point2f> points;
  cv::KeyPoint::convert(features.keypoints, points);
  features.pixels.assign(points.size(), std::vector<std::optional<cv::Point2f>>(count));
  for (std::size_t f = 0; f < points.size(); ++f) features.pixels[f][order[middle]] = points[f];

  for (const int direction : {-1, 1}) {
    // Positions in the two images before are carried on, so that a long path is followed step by
    // step.
    std::vector<cv::Point2f> last = points;
    std::vector<cv::Point2f> step(points.size(), cv::Point2f(0, 0));
    std::vector<std::size_t> alive(points.size());
    std::iota(alive.begin(), alive.end(), std::size_t{0});
    double last_travel = 0.0;
    for (std::ptrdiff_t i = static_cast<std::ptrdiff_t>(middle) + direction;
         i >= 0 && i < static_cast<std::ptrdiff_t>(count) && !alive.empty(); i += direction) {
      const double travel =
          std::abs(scan.positions_m[order[i]] - scan.positions_m[order[i - direction]]);
      const float ratio =
          last_travel > 0.0 ? static_cast<float>(std::min(travel / last_travel, 3.0)) : 0.0f;
      last_travel = travel;
      std::vector<cv::Point2f> from, guess;
      for (std::size_t f : alive) {
        from.push_back(points[f]);
        guess.push_back(last[f] + ratio * step[f]);
      }
      const auto found = follow(pyramids[order[middle]], pyramids[order[i]], from, guess);
      std::vector<std::size_t> next;
      for (std::size_t k = 0; k < alive.size(); ++k) {
        if (!found[k] || inside(cvRound(found[k]->y), cvRound(found[k]->x)) == 0) continue;
        const std::size_t f = alive[k];
        features.pixels[f][order[i]] = *found[k];
        step[f] = *found[k] - last[f];
        last[f] = *found[k];
        next.push_back(f);
      }
      alive = std::move(next);
    }
  }
  return features;
}

/// Mutual best descriptors that pass Lowe's ratio test, as pairs of row numbers.
std::vector<std::pair<int, int>> matchDescriptors(const cv::Mat& a, const cv::Mat& b) {
  std::vector<std::pair<int, int>> pairs;
  if (a.rows < 2 || b.rows < 2) return pairs;
  const auto best = [](const cv::Mat& from, const cv::Mat& to) {
    std::vector<std::vector<cv::DMatch>> nearest;
    cv::BFMatcher(cv::NORM_L2).knnMatch(from, to, nearest, 2);
    std::vector<int> result(from.rows, -1);
    for (int i = 0; i < from.rows; ++i) {
      if (nearest[i].size() == 2 && nearest[i][0].distance < kRatio * nearest[i][1].distance) {
        result[i] = nearest[i][0].trainIdx;
      }
    }
    return result;
  };
  const std::vector<int> forth = best(a, b);
  const std::vector<int> back = best(b, a);
  for (int i = 0; i < a.rows; ++i) {
    if (forth[i] >= 0 && back[forth[i]] == i) pairs.emplace_back(i, forth[i]);
  }
  return pairs;
}

void check(const std::vector<StageScan>& scans) {
  if (scans.empty()) throw Error("no scan: expected images at two or more stage positions");
  const cv::Size size = scans[0].images.empty() ? cv::Size() : scans[0].images[0].size();
  for (std::size_t s = 0; s < scans.size(); ++s) {
    const StageScan& scan = scans[s];
    const std::string name = "scan " + std::to_string(s + 1);
    if (scan.images.size() < 2 || scan.positions_m.size() != scan.images.size()) {
      throw Error(name + " has " + std::to_string(scan.images.size()) + " images and " +
                  std::to_string(scan.positions_m.size()) +
                  " stage positions, expected two or more of each");
    }
    for (const cv::Mat& image : scan.images) {
      if (image.depth() != CV_8U || (image.channels() != 1 && image.channels() != 3)) {
        throw Error(name + " has an image that is not 8 bit with one or three channels");
      }
      if (image.size() != size) throw Error(name + " has images of different size");
    }
    std::vector<double> sorted = scan.positions_m;
    std::sort(sorted.begin(), sorted.end());
    for (std::size_t i = 0; i < sorted.size(); ++i) {
      if (!std::isfinite(sorted[i])) throw Error(name + " has a stage position that is not finite");
      if (i > 0 && sorted[i] - sorted[i - 1] < 1e-6) {
        throw Error(name + " has two images at one stage position (" + std::to_string(sorted[i]) +
                    " m)");
      }
    }
  }
}

}  // namespace

FeatureTracks trackFeatures(const std::vector<StageScan>& scans, const TrackingOptions& options,
                            const Progress& progress) {
  check(scans);
  FeatureTracks result;
  result.image_size = scans[0].images[0].size();
  std::vector<ScanFeatures> features(scans.size());
  const std::string stage = "following features";
  if (progress) progress(0.0, stage);
  const cv::Mat1b inside = ~calibration::outsidePicture(scans, kWindow.width / 2 + 2);
  parallelFor(0, scans.size(), options.threads, [&](std::size_t s) {
    features[s] = trackScan(scans[s], inside, options.features_per_scan);
  });
  if (progress) progress(1.0, stage);

  std::vector<std::vector<int>> track_of(scans.size());
  for (std::size_t s = 0; s < scans.size(); ++s) {
    result.positions_m.push_back(scans[s].positions_m);
    track_of[s].assign(features[s].pixels.size(), -1);
    for (std::size_t f = 0; f < features[s].pixels.size(); ++f) {
      FeatureTrack track;
      for (std::size_t i = 0; i < features[s].pixels[f].size(); ++i) {
        const auto& pixel = features[s].pixels[f][i];
        if (pixel) {
          track.observations.push_back(
              {static_cast<int>(s), static_cast<int>(i), Eigen::Vector2d(pixel->x, pixel->y)});
        }
      }
      if (track.observations.size() < 2) continue;
      track_of[s][f] = static_cast<int>(result.tracks.size());
      result.tracks.push_back(std::move(track));
    }
  }
  for (std::size_t a = 0; a < scans.size(); ++a) {
    for (std::size_t b = a + 1; b < scans.size(); ++b) {
      for (const auto& [fa, fb] :
           matchDescriptors(features[a].descriptors, features[b].descriptors)) {
        if (track_of[a][fa] >= 0 && track_of[b][fb] >= 0) {
          result.matches.push_back({track_of[a][fa], track_of[b][fb]});
        }
      }
    }
  }
  return result;
}

}  // namespace omnister
