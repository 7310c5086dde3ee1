// SPDX-License-Identifier: Apache-2.0
#include "omnister/calibration/next_views.h"

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>

#include "calibration/fit/bundle.h"
#include "omnister/calibration/uncertainty.h"

namespace omnister {
namespace {

using calibration::BundleOptions;
using calibration::BundleState;
using calibration::BundleView;
using calibration::Corner;

/// A grid of corrections has hundreds of numbers; what it lacks is pictures everywhere.
constexpr Eigen::Index kMostParameters = 40;
constexpr double kLeastGain = 0.05;
constexpr double kDegree = M_PI / 180.0;

struct Candidate {
  Pose pose;
  std::vector<Eigen::Vector2d> outline;
  double tilt = 0.0;
  bool about_x = false;
  Eigen::Vector2d middle = Eigen::Vector2d::Zero();
  Eigen::MatrixXd information;  ///< about the lens, in 1/px^2
};

/// The pose of a board whose middle is seen in a direction, tilted against the line of sight.
Pose boardTowards(double theta, double azimuth, double distance, double tilt, bool about_x,
                  const Eigen::Vector3d& middle) {
  const Eigen::Matrix3d turn = (Eigen::AngleAxisd(azimuth, Eigen::Vector3d::UnitZ()) *
                                Eigen::AngleAxisd(theta, Eigen::Vector3d::UnitY()) *
                                Eigen::AngleAxisd(-azimuth, Eigen::Vector3d::UnitZ()))
                                   .toRotationMatrix();
  Pose pose = Pose::Identity();
  pose.linear() =
      turn * Eigen::AngleAxisd(tilt, about_x ? Eigen::Vector3d(Eigen::Vector3d::UnitX())
                                             : Eigen::Vector3d(Eigen::Vector3d::UnitY()))
                 .toRotationMatrix();
  pose.translation() = turn * Eigen::Vector3d(0, 0, distance) - pose.linear() * middle;
  return pose;
}

std::string placeInWords(const Eigen::Vector2d& at, const cv::Size& size) {
  const double x = (at.x() + 0.5) / size.width;
  const double y = (at.y() + 0.5) / size.height;
  const std::string vertical = y < 0.38 ? "upper" : y > 0.62 ? "lower" : "";
  const std::string horizontal = x < 0.38 ? "left" : x > 0.62 ? "right" : "";
  if (vertical.empty() && horizontal.empty()) return "in the middle";
  if (vertical.empty()) return "at the " + horizontal + " edge";
  if (horizontal.empty()) return vertical == "upper" ? "at the top" : "at the bottom";
  return "at the " + vertical + " " + horizontal;
}

class Search {
 public:
  Search(const CalibrationResult& result, const std::vector<Eigen::Vector3d>& board)
      : result_(result), lens_(*result.file.lens), size_(result.file.image_size) {
    Eigen::Vector3d low = board.front();
    Eigen::Vector3d high = board.front();
    for (const Eigen::Vector3d& point : board) {
      low = low.cwiseMin(point);
      high = high.cwiseMax(point);
    }
    middle_ = 0.5 * (low + high);
    outline_ = {low, {high.x(), low.y(), low.z()}, high, {low.x(), high.y(), high.z()}};
    std::vector<double> distances;
    for (const ViewResult& view : result.views) {
      if (view.used) distances.push_back((view.T_camera_board * middle_).norm());
    }
    if (distances.empty()) return;
    std::nth_element(distances.begin(),
                     distances.begin() + static_cast<std::ptrdiff_t>(distances.size() / 2),
                     distances.end());
    const double near = distances[distances.size() / 2];
    for (const double share : {0.0, 0.45, 0.75, 0.95}) {
      const int around = share == 0.0 ? 1 : 8;
      for (int step = 0; step < around; ++step) {
        for (const bool about_x : {false, true}) {
          for (const double tilt : {-35.0 * kDegree, 35.0 * kDegree}) {
            add(board, share * lens_.maxTheta(), 2.0 * M_PI * step / around, near, tilt, about_x);
          }
        }
      }
    }
  }

  std::vector<NextView> best(int count) const {
    std::vector<NextView> views;
    if (!result_.file.covariance || candidates_.empty()) return views;
    Eigen::MatrixXd covariance = *result_.file.covariance;
    if (covariance.rows() > kMostParameters) return views;
    double now = projectionUncertainty(lens_, covariance, size_, 12).rms_px;
    for (int i = 0; i < count; ++i) {
      const Candidate* chosen = nullptr;
      Eigen::MatrixXd with;
      double least = (1.0 - kLeastGain) * now;
      for (const Candidate& candidate : candidates_) {
        const Eigen::MatrixXd trial = afterwards(covariance, candidate.information);
        const double rms = projectionUncertainty(lens_, trial, size_, 12).rms_px;
        if (!(rms < least)) continue;
        least = rms;
        chosen = &candidate;
        with = trial;
      }
      if (chosen == nullptr) break;
      NextView& view = views.emplace_back();
      view.T_camera_board = chosen->pose;
      view.outline = chosen->outline;
      view.uncertainty_px = least;
      view.where = placeInWords(chosen->middle, size_) + ", tilted by 35 degrees with its " +
                   (chosen->about_x ? (chosen->tilt > 0 ? "lower edge" : "upper edge")
                                    : (chosen->tilt > 0 ? "left edge" : "right edge")) +
                   " away from the camera";
      covariance = with;
      now = least;
    }
    return views;
  }

 private:
  void add(const std::vector<Eigen::Vector3d>& board, double theta, double azimuth, double distance,
           double tilt, bool about_x) {
    Candidate candidate;
    candidate.pose = boardTowards(theta, azimuth, distance, tilt, about_x, middle_);
    candidate.tilt = tilt;
    candidate.about_x = about_x;
    std::vector<Corner> corners;
    for (const Eigen::Vector3d& point : board) {
      const auto pixel = lens_.project(candidate.pose * point);
      if (!pixel || !(pixel->x() > 2 && pixel->y() > 2 && pixel->x() < size_.width - 3 &&
                      pixel->y() < size_.height - 3)) {
        continue;
      }
      corners.push_back({*pixel, point, Eigen::Vector2d::Zero()});
      candidate.middle += *pixel;
    }
    // A board that is mostly out of the picture is not found, unless it is coded.
    if (corners.size() < 8 || 10 * corners.size() < 9 * board.size()) return;
    candidate.middle /= static_cast<double>(corners.size());
    for (const Eigen::Vector3d& corner : outline_) {
      if (const auto pixel = lens_.project(candidate.pose * corner)) {
        candidate.outline.push_back(*pixel);
      }
    }
    BundleState state;
    state.lenses = {result_.file.lens};
    state.poses = {candidate.pose};
    BundleView view;
    view.corners = &corners;
    BundleOptions options;
    options.warp = false;
    const double sigma = std::max(result_.rms_px / std::sqrt(2.0), 0.02);
    candidate.information =
        calibration::reducedInformation({view}, options, state) / (sigma * sigma);
    candidates_.push_back(std::move(candidate));
  }

  /// Covariance once a view is seen: C - C (C + I^-1)^-1 C, written for an I that is singular.
  static Eigen::MatrixXd afterwards(const Eigen::MatrixXd& covariance,
                                    const Eigen::MatrixXd& information) {
    const Eigen::Index size = covariance.rows();
    // Numbers of many sizes: by their own standard deviations.
    const Eigen::VectorXd scale = covariance.diagonal().cwiseMax(1e-300).cwiseSqrt();
    const Eigen::MatrixXd c =
        scale.cwiseInverse().asDiagonal() * covariance * scale.cwiseInverse().asDiagonal();
    const Eigen::MatrixXd i = scale.asDiagonal() * information * scale.asDiagonal();
    const Eigen::MatrixXd one = Eigen::MatrixXd::Identity(size, size);
    const Eigen::MatrixXd after = (one + c * i).partialPivLu().solve(c);
    const Eigen::MatrixXd even = 0.5 * (after + after.transpose());
    return scale.asDiagonal() * even * scale.asDiagonal();
  }

  const CalibrationResult& result_;
  const LensModel& lens_;
  cv::Size size_;
  Eigen::Vector3d middle_ = Eigen::Vector3d::Zero();
  std::vector<Eigen::Vector3d> outline_;
  std::vector<Candidate> candidates_;
};

}  // namespace

std::vector<NextView> nextViews(const CalibrationResult& result,
                                const std::vector<Eigen::Vector3d>& board, int count) {
  if (board.empty() || !result.file.lens) return {};
  return Search(result, board).best(count);
}

}  // namespace omnister
