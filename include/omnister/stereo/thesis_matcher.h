// SPDX-License-Identifier: Apache-2.0
/// @file The thesis' matcher to the letter: slow, obvious, and the oracle of the fast ones.
///
/// For every pixel of the reference image (Johnson 1997, sec. 5.1; "right" there is the reference
/// here, "left" the displaced image):
///  1. its ray (x, y, h) goes to the dewarped position (u, v, R0) = (R0 x / h, R0 y / h, R0)
///     (eqs 4.17, 4.18);
///  2. a plane parallel to the image plane at depth Z moves it by the shift R0 t / Z, t being the
///     displaced camera's place: for a sideways move t = (t_x, 0, 0) that is u + n, n = -R0 t_x /
///     Z; for any other pose the displaced camera's rotation is undone as well,
///         (u', v', w') = R^T ((u, v, R0) - R0 t / Z);
///  3. the displaced lens projects it (eqs 4.13, 4.14): over all Z the curved search path
///  (fig. 5.2).
/// The mask around the pixel is either a square of distinct pixels of the distorted reference
/// image, each taken through the three steps (fig. 5.5), or a square of the dewarped space,
/// projected into both images (fig. 5.4). Masks compare by the correlation C of eq. 3.1, and the
/// largest C wins. The depth comes from eq. 2.1 for a sideways move without rotation, else from the
/// nearest point of the two rays (eqs 2.2-2.9).
///
/// Beyond the thesis, because rays at 90 degrees and more have no dewarped position: a mask with a
/// ray further off the axis than ThesisOptions::object_plane_limit takes planes normal to the ray
/// of its middle pixel instead of planes parallel to the image plane. The steps are the same; (u,
/// v, R0) is then R0 ray / (ray . middle ray), and Z is the range along the middle ray.
#pragma once

#include <memory>
#include <string_view>

#include "omnister/stereo/matcher.h"

namespace omnister {

/// What a mask is a square of.
enum class ThesisMask {
  kDewarpedSquare,   ///< Johnson 1997, fig. 5.4
  kDistortedPixels,  ///< Johnson 1997, fig. 5.5, the one chosen there
};

/// "fig5.4" or "fig5.5". @throws Error for another name
ThesisMask parseThesisMask(std::string_view name);

struct ThesisOptions {
  ThesisMask mask = ThesisMask::kDistortedPixels;
  int window = 11;                    ///< side of the mask, odd, 3 to 99 [px]
  bool subpixel = true;               ///< parabola through the best C and its neighbours
  double object_plane_limit = 1.396;  ///< off-axis angle, below pi/2 [rad]; 80 degrees
  double min_contrast = 1.0;          ///< least standard deviation of the mask's grey levels
};

/// Candidates of a pixel are evenly spaced in n (so in inverse range), as many as it takes to step
/// by at most one pixel of the displaced image, up to MatcherOptions::hypotheses. With several
/// displaced images C is the mean over those that see the whole mask.
///
/// A pixel gets a range only where the largest C is inside the search limits, has a neighbour on
/// both sides, and the range is better known than to 100 %; MatchStatistics::rejected names
/// `masked`, `outside_field`, `no_texture`, `unseen` (no candidate has its mask inside a displaced
/// image), `at_limit`, `no_parallax`. There is no left-right check: occluded pixels get the best
/// that there is. Score is C. Sigma supposes an error of a quarter pixel along the path.
///
/// @throws Error as makeMatcher() does
std::unique_ptr<Matcher> makeThesisMatcher(const StereoGeometry& geometry,
                                           const MatcherOptions& options,
                                           const ThesisOptions& thesis = {});

}  // namespace omnister
