// SPDX-License-Identifier: Apache-2.0
#include "omnister/lens/lens_part.h"

#include <cmath>
#include <set>

#include "omnister/common/error.h"
#include "omnister/lens/lens_models.h"

namespace omnister {
namespace {

/// What a parameter is multiplied by when pixels become so many times as long. Names and units are
/// those of docs/lens_models.md.
double scaleOf(const std::string& model, const std::string& name, double pixels) {
  static const std::set<std::string> kLengths = {"R", "R0", "f", "radii"};
  if (kLengths.count(name) != 0) return pixels;
  if (model == "quadric" && (name == "a" || name == "b")) return std::sqrt(pixels);
  return 1.0;
}

}  // namespace

LensFile partOfLens(const LensFile& whole, const cv::Rect& region, const cv::Size& binning) {
  const std::string source = "part of a lens";
  if (binning.width < 1 || binning.height < 1) {
    throw InputError(source, "binning", "expected 1 or more pixels");
  }
  const cv::Size size(region.width / binning.width, region.height / binning.height);
  if (size.empty() || (region & cv::Rect({0, 0}, whole.image_size)) != region) {
    throw InputError(source, "region", "is not within the image of the lens");
  }
  const Eigen::Vector2d bins(binning.width, binning.height);
  const Eigen::Vector2d corner =
      Eigen::Vector2d(region.x, region.y) + 0.5 * (bins.array() - 1.0).matrix();
  const Eigen::Vector2d center = (whole.lens->center() - corner).cwiseQuotient(bins);

  const std::string model(whole.lens->model());
  const double scale = 1.0 / bins.y();
  std::map<std::string, std::vector<double>> parameters;
  for (const auto& [name, values] : namedParameters(*whole.lens)) {
    std::vector<double>& scaled = parameters[name];
    for (const double value : values) scaled.push_back(value * scaleOf(model, name, scale));
  }
  if (binning.width != binning.height) {
    // diag(1 / x, 1 / y) [[1 + p, q], [s, 1]] = 1 / y [[(1 + p) y / x, q y / x], [s, 1]]
    const double aspect = bins.y() / bins.x();
    const auto old = [&](const char* name) {
      return parameters.count(name) ? parameters[name].at(0) : 0.0;
    };
    const double p = (1.0 + old("p")) * aspect - 1.0, q = old("q") * aspect;
    parameters["p"] = {p};
    parameters["q"] = {q};
  }
  LensFile part = whole;
  part.image_size = size;
  part.lens = makeLens(model, center, parameters, whole.lens->maxTheta(), source);
  // The numbers are others now; their covariance belongs to the whole sensor's file.
  part.covariance.reset();
  for (std::optional<double>* figure :
       {&part.calibration.rms_px, &part.calibration.holdout_rms_px}) {
    if (*figure) **figure *= scale;
  }
  // It is found anew when the file is written.
  part.calibration.equidistant_residual_px.reset();
  part.calibration.notes["part_of_sensor"] =
      std::to_string(region.width) + "x" + std::to_string(region.height) + " at (" +
      std::to_string(region.x) + ", " + std::to_string(region.y) + "), binned " +
      std::to_string(binning.width) + "x" + std::to_string(binning.height);
  return part;
}

}  // namespace omnister
