// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cmath>
#include <string>

#include "omnister/common/error.h"
#include "stereo/sweep/level/level.h"

namespace omnister {

MatchWindow parseMatchWindow(std::string_view name) {
  if (name == "surface") return MatchWindow::kSurface;
  if (name == "ray") return MatchWindow::kRay;
  if (name == "fronto") return MatchWindow::kFronto;
  if (name == "best") return MatchWindow::kBest;
  throw Error("unknown window '" + printable(name) + "', expected surface, ray, fronto or best");
}

namespace sweep {
namespace {

constexpr int kReach = 4;           ///< pixels to each side that slopes are taken over
constexpr int kPiece = 14;          ///< columns that share slopes, which grow with the hypothesis
constexpr float kSteepest = 1.2f;   ///< columns a pixel that a window may rise
constexpr double kGrazing = 0.174;  ///< cosine below which a ray has no plane parallel to the image

/// Ray of a pixel of the tile in the axes of the epipolar frame; null where there is none.
bool rayAt(const MapView& view, const cv::Point& pixel, Eigen::Vector3d* ray) {
  const cv::Rect there = view.rect & cv::Rect(cv::Point(), view.size);
  if (!there.contains(pixel)) return false;
  const std::size_t at = view.at(pixel.x, pixel.y);
  if (view.phi[at] == kNoRay) return false;
  const double phi = view.phi[at] / kPhiUnits - M_PI, theta = view.a[at];
  *ray = {std::cos(theta), std::sin(theta) * std::cos(phi), std::sin(theta) * std::sin(phi)};
  return true;
}

/// Parallax angle of a plane's point on a ray. @param range of the plane on its middle ray, divided
/// by the baseline
double parallaxOn(const Eigen::Vector3d& ray, const Eigen::Vector3d& middle,
                  const Eigen::Vector3d& normal, double range) {
  const double here = range * normal.dot(middle) / normal.dot(ray);
  const double across = ray.tail<2>().norm();
  return std::atan2(here * across, here * ray.x() - 1.0) - std::atan2(across, ray.x());
}

}  // namespace

void orientGuesses(MatchWindow window, const EpipolarFrame& frame, const Band& band,
                   const Tile& tile, Scratch* scratch) {
  if (window == MatchWindow::kSurface) return;
  const MapView& view = scratch->view;
  const Eigen::Vector3d axis = frame.basis.col(2);
  const std::vector<Guess> seen = scratch->guesses;
  scratch->guesses.clear();
  // Columns a pixel of a window that stands in a plane, at a hypothesis [columns].
  const auto slopes = [&](bool fronto, const cv::Point& pixel, float columns, Guess* guess) {
    guess->x = guess->y = 0;
    Eigen::Vector3d middle;
    const double delta = columns * band.step_h;
    if (!rayAt(view, pixel, &middle) || delta < 1e-6) return;
    const double theta = std::atan2(middle.tail<2>().norm(), middle.x());
    if (theta + delta >= M_PI) return;
    const double range = std::sin(theta + delta) / std::sin(delta);
    const Eigen::Vector3d normal = fronto && axis.dot(middle) > kGrazing ? axis : middle;
    const auto rise = [&](const cv::Point& step) {
      Eigen::Vector3d before, after;
      if (!rayAt(view, pixel - kReach * step, &before) ||
          !rayAt(view, pixel + kReach * step, &after))
        return 0.0f;
      if (normal.dot(before) < 0.1 * kGrazing || normal.dot(after) < 0.1 * kGrazing) return 0.0f;
      const double rise =
          (parallaxOn(after, middle, normal, range) - parallaxOn(before, middle, normal, range)) /
          (2 * kReach * band.step_h);
      return std::clamp(static_cast<float>(rise), -kSteepest, kSteepest);
    };
    guess->x = rise({1, 0});
    guess->y = rise({0, 1});
  };
  for (const Guess& guess : seen) {
    const cv::Point middle(guess.where.x + guess.where.width / 2,
                           guess.where.y + guess.where.height / 2);
    const float u = static_cast<float>(middle.x), v = static_cast<float>(middle.y);
    const float here = guess(u, v);
    for (const auto& [first, last] : guess.intervals) {
      for (int from = first; from <= last; from += kPiece) {
        const int to = std::min(from + kPiece - 1, last);
        for (const bool fronto : {false, true}) {
          if (window == (fronto ? MatchWindow::kRay : MatchWindow::kFronto)) continue;
          Guess turned = guess;
          slopes(fronto, middle + tile.rect.tl(), here + 0.5f * static_cast<float>(from + to),
                 &turned);
          turned.at = here - turned.x * u - turned.y * v;
          // Every pixel is still told all that it was.
          const float off =
              std::fabs(turned.x - guess.x) * static_cast<float>(guess.where.width) / 2 +
              std::fabs(turned.y - guess.y) * static_cast<float>(guess.where.height) / 2;
          const int more = static_cast<int>(std::ceil(off));
          turned.intervals = {{from - more, to + more}};
          scratch->guesses.push_back(turned);
        }
      }
    }
  }
}

}  // namespace sweep
}  // namespace omnister
