// SPDX-License-Identifier: Apache-2.0
#include "omnister/lens/reduced_lens.h"

#include <string>

#include "omnister/common/error.h"

namespace omnister {
namespace {

class ReducedLens : public LensModel {
 public:
  ReducedLens(LensPtr lens, double factor) : lens_(std::move(lens)), factor_(factor) {}

  std::string_view model() const override { return lens_->model(); }
  double maxTheta() const override { return lens_->maxTheta(); }
  Eigen::VectorXd parameters() const override { return lens_->parameters(); }
  std::vector<std::string> parameterNames() const override { return lens_->parameterNames(); }

  std::optional<Eigen::Vector2d> project(const Eigen::Vector3d& bearing, Jacobian23* d_bearing,
                                         JacobianParams* d_parameters) const override {
    const auto pixel = lens_->project(bearing, d_bearing, d_parameters);
    if (!pixel) return std::nullopt;
    if (d_bearing != nullptr) *d_bearing /= factor_;
    if (d_parameters != nullptr) *d_parameters /= factor_;
    return Eigen::Vector2d((pixel->array() + 0.5) / factor_ - 0.5);
  }

  std::optional<Eigen::Vector3d> unproject(const Eigen::Vector2d& pixel,
                                           Jacobian32* d_pixel) const override {
    const auto ray =
        lens_->unproject(Eigen::Vector2d((pixel.array() + 0.5) * factor_ - 0.5), d_pixel);
    if (ray && d_pixel != nullptr) *d_pixel *= factor_;
    return ray;
  }

  std::optional<double> surfaceHeight(double x, double y) const override {
    const auto height = lens_->surfaceHeight(x * factor_, y * factor_);
    if (!height) return std::nullopt;
    return *height / factor_;
  }

  LensPtr withParameters(const Eigen::VectorXd& parameters,
                         std::optional<double> max_theta) const override {
    LensPtr other = lens_->withParameters(parameters, max_theta);
    if (!other) return nullptr;
    return std::make_shared<ReducedLens>(std::move(other), factor_);
  }

 private:
  LensPtr lens_;
  double factor_;
};

}  // namespace

LensPtr reducedLens(const LensPtr& lens, int factor) {
  if (!lens) throw Error("there is no lens to reduce");
  if (factor < 1 || factor > 64)
    throw Error("images are to be reduced " + std::to_string(factor) + " times, expected 1 to 64");
  if (factor == 1) return lens;
  return std::make_shared<ReducedLens>(lens, factor);
}

}  // namespace omnister
