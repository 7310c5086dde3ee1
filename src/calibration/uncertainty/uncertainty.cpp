// SPDX-License-Identifier: Apache-2.0
#include "omnister/calibration/uncertainty.h"

#include <Eigen/Cholesky>
#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>

#include "omnister/common/error.h"

namespace omnister {

namespace {

struct GridPoint {
  std::size_t index;  ///< in the grid
  Eigen::Vector3d bearing;
  Eigen::Vector2d pixel;
  Jacobian23 d_bearing;
  Eigen::Matrix<double, 2, 3> d_rotation;  ///< d(pixel)/d(small rotation of the camera)
  JacobianParams d_parameters;
};

Eigen::Matrix3d cross(const Eigen::Vector3d& v) {
  Eigen::Matrix3d m;
  m << 0, -v.z(), v.y(), v.z(), 0, -v.x(), -v.y(), v.x(), 0;
  return m;
}

std::vector<GridPoint> gridOf(const LensModel& lens, cv::Size size, int cols,
                              ProjectionField& field) {
  field.image_size = size;
  field.cols = std::max(2, cols);
  field.rows = std::max(2, static_cast<int>(std::lround(static_cast<double>(field.cols) *
                                                        size.height / std::max(1, size.width))));
  field.sigma_px.assign(static_cast<std::size_t>(field.cols) * static_cast<std::size_t>(field.rows),
                        std::nan(""));
  std::vector<GridPoint> points;
  for (int row = 0; row < field.rows; ++row) {
    for (int col = 0; col < field.cols; ++col) {
      GridPoint point;
      point.index = static_cast<std::size_t>(row * field.cols + col);
      point.pixel = Eigen::Vector2d((size.width - 1.0) * col / (field.cols - 1),
                                    (size.height - 1.0) * row / (field.rows - 1));
      const auto bearing = lens.unproject(point.pixel);
      if (!bearing) continue;
      point.bearing = *bearing;
      if (!lens.project(point.bearing, &point.d_bearing, &point.d_parameters)) continue;
      point.d_rotation = -point.d_bearing * cross(point.bearing);
      points.push_back(std::move(point));
    }
  }
  return points;
}

void summarize(ProjectionField& field) {
  double squares = 0.0;
  std::size_t count = 0;
  for (const double sigma : field.sigma_px) {
    if (std::isnan(sigma)) continue;
    squares += sigma * sigma;
    field.max_px = std::max(field.max_px, sigma);
    ++count;
  }
  field.rms_px = count > 0 ? std::sqrt(squares / static_cast<double>(count)) : std::nan("");
}

}  // namespace

ProjectionField projectionUncertainty(const LensModel& lens, const Eigen::MatrixXd& covariance,
                                      cv::Size image_size, int cols) {
  const Eigen::Index size = lens.parameters().size();
  if (covariance.rows() != size || covariance.cols() != size) {
    throw Error("the covariance has " + std::to_string(covariance.rows()) + " rows, the lens has " +
                std::to_string(size) + " parameters");
  }
  ProjectionField field;
  const auto points = gridOf(lens, image_size, cols, field);
  // Least-squares rotation that answers a change of the parameters: w = -(A^T A)^-1 A^T B dp.
  Eigen::Matrix3d normal = Eigen::Matrix3d::Zero();
  Eigen::MatrixXd mixed = Eigen::MatrixXd::Zero(3, size);
  for (const GridPoint& point : points) {
    normal += point.d_rotation.transpose() * point.d_rotation;
    mixed += point.d_rotation.transpose() * point.d_parameters;
  }
  const Eigen::MatrixXd answer = -normal.ldlt().solve(mixed);
  for (const GridPoint& point : points) {
    const Eigen::MatrixXd d = point.d_parameters + point.d_rotation * answer;
    const double variance = (d * covariance * d.transpose()).trace();
    field.sigma_px[point.index] = std::sqrt(std::max(0.0, variance));
  }
  summarize(field);
  return field;
}

ProjectionField projectionUncertaintyAt(const LensModel& lens, const Eigen::MatrixXd& covariance,
                                        cv::Size image_size, double board_distance, double distance,
                                        int cols) {
  const Eigen::Index size = lens.parameters().size();
  if (covariance.rows() != size || covariance.cols() != size || !(board_distance > 0.0) ||
      !(distance > 0.0)) {
    throw Error("uncertainty at a distance needs a covariance of the lens and positive distances");
  }
  ProjectionField field;
  const auto points = gridOf(lens, image_size, cols, field);
  // Rotation, and shift in units of the boards' distance.
  const auto movementOf = [](const GridPoint& point, double nearness) {
    Eigen::Matrix<double, 2, 6> d;
    d << point.d_rotation, nearness * point.d_bearing;
    return d;
  };
  Eigen::Matrix<double, 6, 6> normal = Eigen::Matrix<double, 6, 6>::Zero();
  Eigen::MatrixXd mixed = Eigen::MatrixXd::Zero(6, size);
  for (const GridPoint& point : points) {
    const Eigen::Matrix<double, 2, 6> d = movementOf(point, 1.0);
    normal += d.transpose() * d;
    mixed += d.transpose() * point.d_parameters;
  }
  const Eigen::MatrixXd answer = -normal.ldlt().solve(mixed);
  for (const GridPoint& point : points) {
    const Eigen::MatrixXd d =
        point.d_parameters + movementOf(point, board_distance / distance) * answer;
    field.sigma_px[point.index] =
        std::sqrt(std::max(0.0, (d * covariance * d.transpose()).trace()));
  }
  summarize(field);
  return field;
}

ProjectionField projectionDifference(const LensModel& lens, const LensModel& other,
                                     cv::Size image_size, int cols) {
  ProjectionField field;
  const auto points = gridOf(lens, image_size, cols, field);
  Eigen::Matrix3d rotation = Eigen::Matrix3d::Identity();
  std::vector<Eigen::Vector2d> difference(points.size(), Eigen::Vector2d::Constant(std::nan("")));
  for (int round = 0; round < 4; ++round) {
    Eigen::Matrix3d normal = 1e-12 * Eigen::Matrix3d::Identity();
    Eigen::Vector3d gradient = Eigen::Vector3d::Zero();
    for (std::size_t i = 0; i < points.size(); ++i) {
      const Eigen::Vector3d rotated = rotation * points[i].bearing;
      Jacobian23 d_bearing;
      const auto pixel = other.project(rotated, &d_bearing);
      difference[i] = pixel ? Eigen::Vector2d(*pixel - points[i].pixel)
                            : Eigen::Vector2d::Constant(std::nan(""));
      if (!pixel) continue;
      const Eigen::Matrix<double, 2, 3> d = -d_bearing * cross(rotated);
      normal += d.transpose() * d;
      gradient += d.transpose() * difference[i];
    }
    if (round == 3) break;
    const Eigen::Vector3d step = normal.ldlt().solve(-gradient);
    const double angle = step.norm();
    if (!(angle > 0.0) || !std::isfinite(angle)) break;
    rotation = Eigen::Matrix3d(Eigen::AngleAxisd(angle, step / angle)) * rotation;
  }
  for (std::size_t i = 0; i < points.size(); ++i)
    field.sigma_px[points[i].index] = difference[i].norm();
  summarize(field);
  return field;
}

}  // namespace omnister
