// SPDX-License-Identifier: Apache-2.0
#include "ros/message/lens_markers.h"

#include <algorithm>
#include <cmath>
#include <opencv2/core/types.hpp>
#include <string>
#include <vector>

namespace omnister {
namespace {

constexpr int kRings = 20;
constexpr int kSectors = 48;
constexpr double kFullColour =
    0.15;  // of the height: departure from the sphere shown in full colour

std_msgs::ColorRGBA colour(double r, double g, double b, double a) {
  std_msgs::ColorRGBA c;
  c.r = static_cast<float>(r);
  c.g = static_cast<float>(g);
  c.b = static_cast<float>(b);
  c.a = static_cast<float>(a);
  return c;
}

visualization_msgs::Marker marker(const std::string& frame_id, const std::string& name, int type) {
  visualization_msgs::Marker result;
  result.header.frame_id = frame_id;
  result.ns = name;
  result.type = type;
  result.action = visualization_msgs::Marker::ADD;
  result.pose.orientation.w = 1.0;
  result.scale.x = result.scale.y = result.scale.z = 1.0;
  result.color = colour(1, 1, 1, 1);
  result.frame_locked = 1;
  return result;
}

Eigen::Vector3d direction(double theta, double phi) {
  return {std::sin(theta) * std::cos(phi), std::sin(theta) * std::sin(phi), std::cos(theta)};
}

/// Outermost off-axis angle at this azimuth that the image shows.
double fieldEnd(const LensFile& file, double phi) {
  const auto seen = [&](double theta) {
    const auto pixel = file.lens->project(direction(theta, phi));
    return pixel && pixel->x() >= -0.5 && pixel->y() >= -0.5 &&
           pixel->x() <= file.image_size.width - 0.5 && pixel->y() <= file.image_size.height - 0.5;
  };
  double inside = 0.0;
  double outside = file.lens->maxTheta();
  if (seen(outside)) return outside;
  for (int i = 0; i < 40; ++i) {
    const double middle = 0.5 * (inside + outside);
    (seen(middle) ? inside : outside) = middle;
  }
  return inside;
}

/// A mesh of rings: vertex(ring, sector), kRings + 1 by kSectors.
void addMesh(const std::vector<Eigen::Vector3d>& vertices,
             const std::vector<std_msgs::ColorRGBA>& colours, visualization_msgs::Marker& mesh) {
  const auto add = [&](int ring, int sector) {
    const auto index = static_cast<std::size_t>(ring * kSectors + sector % kSectors);
    mesh.points.push_back(toPoint(vertices[index]));
    mesh.colors.push_back(colours[index]);
  };
  for (int ring = 0; ring < kRings; ++ring)
    for (int sector = 0; sector < kSectors; ++sector) {
      add(ring, sector);
      add(ring + 1, sector);
      add(ring + 1, sector + 1);
      add(ring, sector);
      add(ring + 1, sector + 1);
      add(ring, sector + 1);
    }
}

}  // namespace

geometry_msgs::Point toPoint(const Eigen::Vector3d& p) {
  geometry_msgs::Point point;
  point.x = p.x();
  point.y = p.y();
  point.z = p.z();
  return point;
}

visualization_msgs::MarkerArray lensMarkers(const LensFile& file, const std::string& frame_id,
                                            double scale, double field_radius) {
  using visualization_msgs::Marker;
  const LensModel& lens = *file.lens;
  const Eigen::Vector2d center = lens.center();
  Marker surface = marker(frame_id, "surface", Marker::TRIANGLE_LIST);
  Marker sphere = marker(frame_id, "sphere", Marker::TRIANGLE_LIST);
  Marker field = marker(frame_id, "field", Marker::LINE_LIST);

  // The height in the middle: pixels a radian there.
  double height = 0.0;
  constexpr double kSmall = 1e-3;
  for (int k = 0; k < 4; ++k)
    if (const auto pixel = lens.project(direction(kSmall, 0.5 * M_PI * k)))
      height += 0.25 * (*pixel - center).norm() / std::tan(kSmall);
  const double metres = scale / std::max(height, 1e-9);

  std::vector<Eigen::Vector3d> on_surface, on_sphere;
  std::vector<std_msgs::ColorRGBA> surface_colours, sphere_colours;
  std::vector<Eigen::Vector3d> border;
  for (int ring = 0; ring <= kRings; ++ring)
    for (int sector = 0; sector < kSectors; ++sector) {
      const double phi = 2.0 * M_PI * sector / kSectors;
      const double theta = std::max(1e-4, fieldEnd(file, phi) * ring / kRings);
      const Eigen::Vector3d ray = direction(theta, phi);
      const auto pixel = lens.project(ray);
      const double r = pixel ? (*pixel - center).norm() : 0.0;
      const double length =
          r / std::sin(theta) * metres;  // so that the point stands over its pixel
      on_surface.push_back(length * ray);
      const double off = std::clamp((length / scale - 1.0) / kFullColour, -1.0, 1.0);
      surface_colours.push_back(colour(0.55 + 0.45 * std::max(off, 0.0),
                                       0.75 - 0.45 * std::abs(off),
                                       0.55 + 0.45 * std::max(-off, 0.0), 0.9));
      // The spherical surface ends at 90 degrees: there it meets the sensor.
      on_sphere.push_back(scale * direction(std::min(theta, 0.5 * M_PI), phi));
      sphere_colours.push_back(colour(0.6, 0.65, 0.7, 0.6));
      if (ring == kRings) border.push_back(field_radius * ray);
    }
  addMesh(on_surface, surface_colours, surface);
  addMesh(on_sphere, sphere_colours, sphere);
  sphere.pose.position.x = 3.0 * scale;

  field.scale.x = 0.004 * field_radius;
  field.color = colour(1.0, 0.85, 0.2, 0.8);
  for (std::size_t i = 0; i < border.size(); ++i) {
    field.points.push_back(toPoint(border[i]));
    field.points.push_back(toPoint(border[(i + 1) % border.size()]));
    if (i % (kSectors / 8) != 0) continue;
    field.points.push_back(toPoint(Eigen::Vector3d::Zero()));
    field.points.push_back(toPoint(border[i]));
  }
  visualization_msgs::MarkerArray result;
  result.markers = {surface, sphere, field};
  return result;
}

}  // namespace omnister
