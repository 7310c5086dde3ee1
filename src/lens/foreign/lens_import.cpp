// SPDX-License-Identifier: Apache-2.0
#include "omnister/lens/lens_import.h"

#include <algorithm>
#include <cmath>

#include "omnister/common/error.h"
#include "omnister/common/numbers.h"

namespace omnister {
namespace {

constexpr double kPi = 3.14159265358979323846;
constexpr double kDegree = kPi / 180.0;
// Wide formulas are fitted at least this far, perspective ones to the image's corner.
constexpr double kWideField = 95.0 * kDegree;
// Where the radius rises slower than this part of its rise on the axis it is as good as turning
// back.
constexpr double kLeastRise = 5e-3;
// Residual over the whole field that needs no second try [px].
constexpr double kNearEnough = 0.04;
// A surface reaches beyond the ordinary field as far as it stays this near [px].
constexpr double kNear = 0.3;
// No richer structure is looked for below this residual [px].
constexpr double kGoodEnough = 1e-3;
constexpr int kAzimuths = 48;
constexpr double kStep = 0.1 * kDegree;

Eigen::Vector3d direction(double theta, double phi) {
  return {std::sin(theta) * std::cos(phi), std::sin(theta) * std::sin(phi), std::cos(theta)};
}

struct Samples {
  std::vector<Eigen::Vector3d> bearings;
  std::vector<Eigen::Vector2d> pixels;
};

Samples sampleField(const ForeignCamera& camera, double max_theta) {
  Samples out;
  constexpr int kRings = 48;
  constexpr int kRays = 16;
  for (int i = 0; i <= kRings; ++i) {
    for (int j = 0; j < (i == 0 ? 1 : kRays); ++j) {
      const Eigen::Vector3d n =
          direction(max_theta * i / kRings, (j + 0.5 * (i % 2)) * 2.0 * kPi / kRays);
      const auto pixel = camera.project(n);
      if (!pixel) continue;
      out.bearings.push_back(n);
      out.pixels.push_back(*pixel);
    }
  }
  return out;
}

void measure(const ForeignCamera& camera, LensFit& fit) {
  const Samples samples = sampleField(camera, fit.lens->maxTheta());
  double sum = 0.0;
  fit.max_px = 0.0;
  for (std::size_t i = 0; i < samples.bearings.size(); ++i) {
    const auto pixel = fit.lens->project(samples.bearings[i]);
    const double error = pixel ? (*pixel - samples.pixels[i]).norm() : 0.0;
    sum += error * error;
    fit.max_px = std::max(fit.max_px, error);
  }
  fit.rms_px = std::sqrt(sum / static_cast<double>(samples.bearings.size()));
}

// The numbers that both lenses have by name, from `from`; the others neutral, from `to`.
LensPtr carryOver(const LensModel& from, const LensPtr& to) {
  const std::vector<std::string> known = from.parameterNames();
  const std::vector<std::string> names = to->parameterNames();
  const Eigen::VectorXd values = from.parameters();
  Eigen::VectorXd parameters = to->parameters();
  for (std::size_t i = 0; i < names.size(); ++i) {
    const auto place = std::find(known.begin(), known.end(), names[i]);
    if (place != known.end()) parameters[i] = values[place - known.begin()];
  }
  const LensPtr out = to->withParameters(parameters);
  return out != nullptr ? out : to;
}

// Fits the simplest structure that no richer one clearly beats.
void fitOver(const ForeignCamera& camera, const LensStructure& plain, double max_theta,
             ForeignFit& best) {
  const Eigen::Vector2d center = *camera.project({0.0, 0.0, 1.0});
  // Pixels per radian on the axis, the geometric mean of both directions.
  const double dx = (*camera.project(direction(1e-4, 0.0)) - center).norm() / 1e-4;
  const double dy = (*camera.project(direction(1e-4, kPi / 2)) - center).norm() / 1e-4;
  const double focal = std::sqrt(dx * dy);
  const bool bends = plain.model == "asphere" || plain.model == "spline";
  LensFitOptions options;
  if (plain.model == "spline") {
    options.tolerance = 1e-8;  // almost linear: converges at once
  } else {
    options.max_iterations = 300;  // a long valley, but few numbers
  }
  for (int bend = 0; bend < (bends ? 3 : 1); ++bend) {
    for (int affine = 0; affine < 3; ++affine) {
      if (best.fit.lens != nullptr && best.fit.rms_px < kGoodEnough) return;
      LensStructure structure = plain;
      structure.decentring = bend > 0;
      structure.decentring_growth = bend > 1;
      structure.affinity = affine > 0;
      structure.turn = affine > 1;
      // A spherical surface ends before 90 degrees, so its field may be less than was asked for.
      LensPtr start = makeLens(structure, center, focal, max_theta);
      if (best.fit.lens != nullptr) start = carryOver(*best.fit.lens, start);
      const Samples samples = sampleField(camera, start->maxTheta());
      LensFit fit = fitLens(*start, samples.bearings, samples.pixels, options);
      // A richer structure has to earn its place.
      if (best.fit.lens == nullptr || fit.rms_px < 0.95 * best.fit.rms_px) {
        best.fit = std::move(fit);
        best.structure = structure;
      }
    }
  }
}

// Widens the field ring by ring while the surface stays one-to-one and near the camera.
void extendField(const ForeignCamera& camera, double wanted, LensFit& fit) {
  LensPtr widest;
  constexpr double kRing = 0.5 * kDegree;
  for (double theta = fit.lens->maxTheta() + kRing; theta <= wanted; theta += kRing) {
    const LensPtr wider = fit.lens->withParameters(fit.lens->parameters(), theta);
    if (wider == nullptr || wider->maxTheta() < theta) break;
    bool near = true;
    for (int j = 0; j < kAzimuths && near; ++j) {
      const Eigen::Vector3d n = direction(theta * (1.0 - 1e-12), j * 2.0 * kPi / kAzimuths);
      const auto pixel = wider->project(n);
      const auto expected = camera.project(n);
      near = pixel && expected && (*pixel - *expected).norm() <= kNear;
    }
    if (!near) break;
    widest = wider;
  }
  if (widest == nullptr) return;
  fit.lens = widest;
  measure(camera, fit);
}

}  // namespace

ForeignField foreignField(const ForeignCamera& camera) {
  const auto on_axis = camera.project({0.0, 0.0, 1.0});
  if (!on_axis) throw Error("the optical axis has no image in this calibration");
  ForeignField out;
  out.one_to_one = kPi - 1e-2;
  const auto inside = [&](const Eigen::Vector2d& pixel) {
    return pixel.x() >= -0.5 && pixel.y() >= -0.5 && pixel.x() <= camera.image_size.width - 0.5 &&
           pixel.y() <= camera.image_size.height - 0.5;
  };
  for (int j = 0; j < kAzimuths; ++j) {
    const double phi = j * 2.0 * kPi / kAzimuths;
    double last = 0.0;
    double first_rise = 0.0;
    for (int i = 1; i * kStep < out.one_to_one; ++i) {
      const auto pixel = camera.project(direction(i * kStep, phi));
      const double radius = pixel ? (*pixel - *on_axis).norm() : 0.0;
      const double rise = radius - last;
      if (i == 1) first_rise = rise;
      if (!pixel || !std::isfinite(radius) || !(rise > kLeastRise * first_rise) ||
          !(first_rise > 0.0)) {
        out.one_to_one = (i - 1) * kStep;
        break;
      }
      if (inside(*pixel)) out.image = std::max(out.image, i * kStep);
      last = radius;
    }
  }
  out.image = std::min(out.image, out.one_to_one);
  // The corners lie between the azimuths looked at.
  double wanted = out.image + 1.0 * kDegree;
  if (camera.wide) wanted = std::max(wanted, kWideField);
  out.max_theta = std::min(wanted, out.one_to_one);
  return out;
}

ForeignFit fitForeignCamera(const ForeignCamera& camera, const std::string& model, int even_terms,
                            int knots) {
  ForeignFit best;
  const ForeignField field = foreignField(camera);
  if (!(field.max_theta > 1.0 * kDegree)) {
    throw Error("this calibration is one-to-one over less than a degree around its axis");
  }
  LensStructure plain;
  plain.model = model;
  plain.even_terms = even_terms;
  plain.knots = knots;
  fitOver(camera, plain, field.max_theta, best);
  if (best.fit.rms_px > kNearEnough && field.max_theta > kWideField) {
    // No surface of this kind says the whole field: say the ordinary field first, then as much of
    // the rest as stays near.
    best = {};
    fitOver(camera, plain, kWideField, best);
    extendField(camera, field.max_theta, best.fit);
  }
  best.field = field;
  return best;
}

}  // namespace omnister
