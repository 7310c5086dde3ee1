// SPDX-License-Identifier: Apache-2.0
#include "calibration/detect/point_refinement.h"

#include <Eigen/Dense>
#include <algorithm>
#include <array>
#include <cmath>

#include "calibration/target/tag_families.h"

namespace omnister::detect {
namespace {

constexpr double kMinContrast = 1.5;
constexpr double kMinDotContrast = 3.0;

double shorterAxis(const Eigen::Matrix2d& jacobian) {
  // Distance of neighbours may be shorter than either axis when the board is seen aslant.
  const Eigen::JacobiSVD<Eigen::Matrix2d> svd(jacobian);
  const double least = svd.singularValues()(1);
  return std::max(least, 0.5 * std::min(jacobian.col(0).norm(), jacobian.col(1).norm()));
}

unsigned darkQuadrants(const Target& target, int id, bool first_square_dark) {
  const Eigen::Vector2i grid = targetGrid(target);
  const int col = id % grid.x();
  const int row = id / grid.x();
  bool plus_plus_dark = (col + row) % 2 == 0;
  if (target.type == TargetType::kCharuco) {
    plus_plus_dark = tags::charucoBlack(target, col + 1, row + 1);
  } else if (!first_square_dark) {
    plus_plus_dark = !plus_plus_dark;
  }
  return plus_plus_dark ? kPlusPlus | kMinusMinus : kMinusPlus | kPlusMinus;
}

// How far from a chess corner only its own four squares are [m].
double clearReach(const Target& target) {
  const double inset = 0.5 * (target.square_m - target.marker_m);
  return target.type == TargetType::kCharuco ? inset : 0.5 * target.square_m;
}

// The picture of a corner: two blurred edges that cross, each bent as a wide-angle lens bends it,
//     I = mean + slope . d + contrast shape(erf(u / blur), erf(v / blur)),  d = pixel - corner,
//     u = n . d + bend (t . d)^2 with normal n and tangent t of the one edge, v alike of the other.
// Shape is e f where four squares meet (a saddle), and (1 + s e)(1 + r f) / 2 - 1 for a dark
// quadrant in the white, which the signs s and r choose.
struct CornerFit {
  enum {
    kX,
    kY,
    kAngle1,
    kAngle2,
    kBend1,
    kBend2,
    kMean,
    kContrast,
    kSlopeX,
    kSlopeY,
    kBlur,
    kCount
  };
  using Vector = Eigen::Matrix<double, kCount, 1>;
  using Matrix = Eigen::Matrix<double, kCount, kCount>;

  struct Sample {
    double x, y, gray;
  };

  bool saddle = true;
  double sign[2] = {1.0, 1.0};  ///< s and r

  double model(const Vector& p, double x, double y, Vector* slope) const {
    const double dx = x - p(kX);
    const double dy = y - p(kY);
    double edge[2], steep[2], along[2], across[2], u[2], tx[2], ty[2];
    for (int i = 0; i < 2; ++i) {
      tx[i] = std::cos(p(kAngle1 + i));
      ty[i] = std::sin(p(kAngle1 + i));
      along[i] = tx[i] * dx + ty[i] * dy;
      across[i] = -ty[i] * dx + tx[i] * dy;
      u[i] = (across[i] + p(kBend1 + i) * along[i] * along[i]) / p(kBlur);
      edge[i] = std::erf(u[i]);
      steep[i] = M_2_SQRTPI * std::exp(-u[i] * u[i]);
    }
    double shape = edge[0] * edge[1];
    double rise[2] = {edge[1], edge[0]};  // d(shape)/d(edge)
    if (!saddle) {
      shape = 0.5 * (1.0 + sign[0] * edge[0]) * (1.0 + sign[1] * edge[1]) - 1.0;
      for (int i = 0; i < 2; ++i) rise[i] = 0.5 * sign[i] * (1.0 + sign[1 - i] * edge[1 - i]);
    }
    if (slope != nullptr) {
      slope->setZero();
      for (int i = 0; i < 2; ++i) {
        const double gain = p(kContrast) * rise[i] * steep[i] / p(kBlur);
        const double bend = 2.0 * p(kBend1 + i) * along[i];
        (*slope)(kX) += gain * (ty[i] - bend * tx[i]);
        (*slope)(kY) += gain * (-tx[i] - bend * ty[i]);
        (*slope)(kAngle1 + i) = gain * (-along[i] + bend * across[i]);
        (*slope)(kBend1 + i) = gain * along[i] * along[i];
        (*slope)(kBlur) -= gain * u[i];
      }
      (*slope)(kMean) = 1.0;
      (*slope)(kContrast) = shape;
      (*slope)(kSlopeX) = dx;
      (*slope)(kSlopeY) = dy;
      (*slope)(kX) -= p(kSlopeX);
      (*slope)(kY) -= p(kSlopeY);
    }
    return p(kMean) + p(kSlopeX) * dx + p(kSlopeY) * dy + p(kContrast) * shape;
  }

  // Bends that no lens makes are held back: half a pixel over the window at one sigma of ten grey
  // levels.
  double cost(const std::vector<Sample>& samples, const Vector& p, double bend_weight,
              Matrix* normal, Vector* right) const {
    double sum = bend_weight * (p(kBend1) * p(kBend1) + p(kBend2) * p(kBend2));
    if (normal != nullptr) {
      normal->setZero();
      right->setZero();
      for (const int i : {kBend1, kBend2}) {
        (*normal)(i, i) = bend_weight;
        (*right)(i) = bend_weight * p(i);
      }
    }
    Vector slope;
    for (const Sample& sample : samples) {
      const double off =
          model(p, sample.x, sample.y, normal != nullptr ? &slope : nullptr) - sample.gray;
      sum += off * off;
      if (normal == nullptr) continue;
      normal->selfadjointView<Eigen::Lower>().rankUpdate(slope);
      *right += off * slope;
    }
    return sum;
  }
};

// Width of a tag's black border as a share of the tag: the narrower one where it is not known.
double borderShare(const Target& target) {
  const int bits = std::max(1, target.border_bits);
  return static_cast<double>(bits) / tags::aprilFamily(target.dictionary, bits)->width_at_border;
}

// Width of the tags' black border where it is not known: a border of two bits is dark as far in as
// the code of the others begins.
int borderSeen(const cv::Mat& fine, const Target& target, const Expected& expected) {
  const int cells = tags::aprilFamily(target.dictionary, 2)->width_at_border;
  const double in = 1.5 / cells * target.square_m;
  const double rim = 0.5 / cells * target.square_m;
  int dark = 0;
  int light = 0;
  for (std::size_t id = 0; id < expected.size(); ++id) {
    if (!expected[id]) continue;
    const int col = static_cast<int>(id) % (2 * target.cols);
    const int row = static_cast<int>(id) / (2 * target.cols);
    const Eigen::Vector2d way(col % 2 == 0 ? 1.0 : -1.0, row % 2 == 0 ? 1.0 : -1.0);
    const auto at = [&](double x, double y) {
      return grayAt(fine, expected[id]->pixel +
                              expected[id]->jacobian * Eigen::Vector2d(x * way.x(), y * way.y()));
    };
    const auto white = at(0.25 * target.square_m, -0.4 * target.spacing * target.square_m);
    const auto black = at(0.25 * target.square_m, rim);
    if (!white || !black || *white - *black < 8.0) continue;
    for (double along = 1.5; along < 0.5 * cells; ++along) {
      for (const bool across : {false, true}) {
        const double x = along / cells * target.square_m;
        const auto gray = across ? at(in, x) : at(x, in);
        if (gray) (*gray < 0.5 * (*white + *black) ? dark : light) += 1;
      }
    }
  }
  return dark > 9 * light ? 2 : 1;
}

// Whether the picture shows dark squares at the corners of the tags: by the middles of the squares
// against border and gap beside them, most tags deciding.
bool showsJoiningSquares(const cv::Mat& fine, const Target& target, const Expected& expected) {
  const double out = 0.5 * target.spacing * target.square_m;
  const double in = 0.5 * borderShare(target) * target.square_m;
  const double along = 0.25 * target.square_m;
  int dark = 0;
  int light = 0;
  for (std::size_t id = 0; id < expected.size(); ++id) {
    if (!expected[id]) continue;
    const int col = static_cast<int>(id) % (2 * target.cols);
    const int row = static_cast<int>(id) / (2 * target.cols);
    // Outwards from the tag.
    const Eigen::Vector2d way(col % 2 == 0 ? -1.0 : 1.0, row % 2 == 0 ? -1.0 : 1.0);
    const auto at = [&](double x, double y) {
      return grayAt(fine, expected[id]->pixel +
                              expected[id]->jacobian * Eigen::Vector2d(x * way.x(), y * way.y()));
    };
    const auto square = at(out, out);
    const auto border = at(-in, -in);
    const auto gap_x = at(-along, out);
    const auto gap_y = at(out, -along);
    if (!square || !border || !gap_x || !gap_y) continue;
    const double white = 0.5 * (*gap_x + *gap_y);
    if (white - *border < 8.0) continue;
    (*square < 0.5 * (white + *border) ? dark : light) += 1;
  }
  return dark + light > 0 ? dark > light : target.joining_squares;
}

// Where only a corner's own edges are, in the board's axes about it [m].
struct Clear {
  double half = 0.0;   ///< half side of the square looked at
  unsigned coded = 0;  ///< quadrants with a code inside
  double inset = 0.0;  ///< how far from the edges the code stays
};

Clear clearAround(const Target& target, unsigned dark) {
  if (target.type == TargetType::kAprilGrid) {
    return {std::min(target.spacing, 0.5) * target.square_m, dark,
            target.square_m * borderShare(target)};
  }
  const unsigned light = (kPlusPlus | kMinusPlus | kMinusMinus | kPlusMinus) & ~dark;
  const bool charuco = target.type == TargetType::kCharuco;
  return {0.5 * target.square_m, charuco ? light : 0u, 0.5 * (target.square_m - target.marker_m)};
}

// Fits the model above around the corner.
// @param dark quadrants of the four squares that are dark   @param code what the fit must keep out
// of
std::optional<Eigen::Vector2d> fitCorner(const cv::Mat& fine, unsigned dark, const Clear& clear,
                                         const LocalFrame& frame) {
  const double axis = shorterAxis(frame.jacobian);
  const double radius = std::clamp(0.8 * clear.half * axis, 3.0, 12.0);
  const Eigen::Matrix2d inverse = frame.jacobian.inverse();
  if (!inverse.allFinite()) return std::nullopt;
  // Less the blur of what lies beyond.
  const double blur = 1.0 / axis;
  const double half = std::max(clear.half - blur, 0.6 * clear.half);
  const double inset = std::max(clear.inset - blur, 0.3 * clear.inset);
  std::vector<CornerFit::Sample> samples;
  double low = 1e300;
  double high = -1e300;
  const int left = static_cast<int>(std::ceil(frame.pixel.x() - radius));
  const int top = static_cast<int>(std::ceil(frame.pixel.y() - radius));
  for (int y = std::max(0, top); y <= std::min(fine.rows - 1.0, frame.pixel.y() + radius); ++y) {
    for (int x = std::max(0, left); x <= std::min(fine.cols - 1.0, frame.pixel.x() + radius); ++x) {
      const Eigen::Vector2d offset(x - frame.pixel.x(), y - frame.pixel.y());
      if (offset.squaredNorm() > radius * radius) continue;
      const Eigen::Vector2d place = inverse * offset;
      const unsigned quadrant = place.y() > 0 ? (place.x() > 0 ? kPlusPlus : kMinusPlus)
                                              : (place.x() > 0 ? kPlusMinus : kMinusMinus);
      const Eigen::Vector2d off = place.cwiseAbs();
      if ((clear.coded & quadrant) != 0 ? off.minCoeff() > inset : off.maxCoeff() > half) continue;
      const double gray = fine.depth() == CV_8U ? fine.at<uchar>(y, x) : fine.at<float>(y, x);
      samples.push_back({offset.x(), offset.y(), gray});
      low = std::min(low, gray);
      high = std::max(high, gray);
    }
  }
  if (samples.size() < 20) return std::nullopt;
  CornerFit::Vector p = CornerFit::Vector::Zero();
  p(CornerFit::kAngle1) = std::atan2(frame.jacobian(1, 0), frame.jacobian(0, 0));
  p(CornerFit::kAngle2) = std::atan2(frame.jacobian(1, 1), frame.jacobian(0, 1));
  p(CornerFit::kMean) = 0.5 * (low + high);
  // Left of the x edge and of the y edge is (-x, +y) or (+x, -y): with u, v above, u v < 0 for (+,
  // +).
  p(CornerFit::kContrast) = 0.45 * (high - low) * ((dark & kPlusPlus) != 0 ? 1.0 : -1.0);
  CornerFit fit;
  if ((dark & (dark - 1)) == 0) {
    fit.saddle = false;
    fit.sign[0] = (dark & (kPlusPlus | kMinusPlus)) != 0 ? 1.0 : -1.0;
    fit.sign[1] = (dark & (kMinusPlus | kMinusMinus)) != 0 ? 1.0 : -1.0;
    p(CornerFit::kContrast) = -0.45 * (high - low);
  }
  p(CornerFit::kBlur) = 1.0;
  const double start_contrast = p(CornerFit::kContrast);
  const double bend_weight = 100.0 * std::pow(radius, 4);
  CornerFit::Matrix normal;
  CornerFit::Vector right;
  double cost = fit.cost(samples, p, bend_weight, &normal, &right);
  double damping = 1e-3;
  for (int round = 0; round < 20 && damping < 1e6; ++round) {
    CornerFit::Matrix damped = normal;
    damped.diagonal() *= 1.0 + damping;
    damped.diagonal().array() += 1e-9;
    const CornerFit::Vector step = -damped.selfadjointView<Eigen::Lower>().ldlt().solve(right);
    if (!step.allFinite()) return std::nullopt;
    CornerFit::Vector next = p + step;
    next(CornerFit::kBlur) = std::clamp(next(CornerFit::kBlur), 0.3, 0.5 * radius);
    const double next_cost = fit.cost(samples, next, bend_weight, nullptr, nullptr);
    if (!(next_cost < cost)) {
      damping *= 10.0;
      continue;
    }
    const bool settled = step.head<2>().norm() < 1e-3;
    p = next;
    if (settled) break;
    cost = fit.cost(samples, p, bend_weight, &normal, &right);
    damping *= 0.1;
  }
  // The edges must have stayed the edges, and explain most of what is seen.
  const double rms = std::sqrt(cost / static_cast<double>(samples.size()));
  if (p(CornerFit::kContrast) * start_contrast <= 0.0 ||
      rms > 0.5 * std::abs(p(CornerFit::kContrast)) || p.head<2>().norm() > 0.5 * radius) {
    return std::nullopt;
  }
  return Eigen::Vector2d(frame.pixel + p.head<2>());
}

void measureCorners(const cv::Mat& fine, const Target& target, const Expected& expected,
                    bool first_square_dark, Measured& measured) {
  const double reach = clearReach(target);
  for (std::size_t id = 0; id < expected.size(); ++id) {
    if (!expected[id]) continue;
    const LocalFrame& frame = *expected[id];
    const double axis = shorterAxis(frame.jacobian);
    const double spacing = axis * target.square_m;
    // A marker's own corner must stay out of the window.
    const double clear =
        target.type == TargetType::kCharuco ? std::min(spacing, 3.2 * reach * axis) : spacing;
    std::vector<cv::Point2f> corner{
        {static_cast<float>(frame.pixel.x()), static_cast<float>(frame.pixel.y())}};
    if (!refineCorners(fine, {halfWindow(clear)}, corner)[0]) continue;
    Eigen::Vector2d pixel(corner[0].x, corner[0].y);
    const double limit = std::max(2.0, 0.25 * spacing);
    if ((pixel - frame.pixel).norm() > limit) continue;
    const unsigned dark = darkQuadrants(target, static_cast<int>(id), first_square_dark);
    if (cornerContrast(fine, {pixel, frame.jacobian}, dark, 0.8 * reach) < kMinContrast) continue;
    const auto fitted = fitCorner(fine, dark, clearAround(target, dark), {pixel, frame.jacobian});
    if (fitted && (*fitted - frame.pixel).norm() <= limit) pixel = *fitted;
    measured[id] = pixel;
  }
}

// One side of a tag as a bent line: offset from its chord, a + b s + c s^2, along the chord s [px].
struct Side {
  Eigen::Vector2d origin;
  Eigen::Vector2d along;
  Eigen::Vector2d across;  ///< out of the tag
  Eigen::Vector3d bend = Eigen::Vector3d::Zero();
};

Side chord(const Eigen::Vector2d& begin, const Eigen::Vector2d& end,
           const Eigen::Vector2d& inside) {
  Side side;
  side.origin = begin;
  side.along = (end - begin).normalized();
  side.across = {side.along.y(), -side.along.x()};
  if (side.across.dot(inside - begin) > 0.0) side.across = -side.across;
  return side;
}

// Moves a side to where the picture steps from dark to light, found on short lines across it: from
// `begin` to `end` along the chord and `half` to both sides of where it is now [px].
bool fitSide(const cv::Mat& fine, double begin, double end, double half, Side& side) {
  const double length = end - begin;
  if (!(length > 6.0)) return false;
  constexpr double kStep = 0.5;
  const int steps = std::max(3, static_cast<int>(std::lround(half / kStep)));
  // The corners themselves are rounded by the lens.
  const double inset = std::max(2.0, 0.06 * length);
  std::vector<Eigen::Vector2d> places;
  for (int i = 0; begin + inset + i <= end - inset; ++i) {
    const double s = begin + inset + i;
    const double here = side.bend(0) + side.bend(1) * s + side.bend(2) * s * s;
    double weight = 0.0;
    double moment = 0.0;
    std::optional<double> last;
    for (int k = -steps; k <= steps; ++k) {
      const double across = here + k * kStep;
      const auto gray = grayAt(fine, side.origin + s * side.along + across * side.across);
      if (!gray) {
        weight = 0.0;
        break;
      }
      if (last && *gray > *last) {
        // Squared, so that the step outweighs the noise beside it.
        const double rise = (*gray - *last) * (*gray - *last);
        weight += rise;
        moment += rise * (across - 0.5 * kStep);
      }
      last = gray;
    }
    if (weight > 25.0) places.emplace_back(s, moment / weight);
  }
  if (places.size() < 5 || places.size() < 0.6 * (length - 2 * inset)) return false;
  // A parabola by least squares, twice more with what is off left less of a say.
  std::vector<double> trust(places.size(), 1.0);
  Eigen::Vector3d bend = Eigen::Vector3d::Zero();
  for (int round = 0; round < 3; ++round) {
    Eigen::Matrix3d normal = Eigen::Matrix3d::Zero();
    Eigen::Vector3d right = Eigen::Vector3d::Zero();
    for (std::size_t i = 0; i < places.size(); ++i) {
      const double s = places[i].x() / length;
      const Eigen::Vector3d row(1.0, s, s * s);
      normal += trust[i] * row * row.transpose();
      right += trust[i] * places[i].y() * row;
    }
    normal(2, 2) += 1e-3;  // short sides show no bend
    bend = normal.ldlt().solve(right);
    for (std::size_t i = 0; i < places.size(); ++i) {
      const double s = places[i].x() / length;
      const double off = std::abs(places[i].y() - bend.dot(Eigen::Vector3d(1.0, s, s * s)));
      trust[i] = off < 0.15 ? 1.0 : 0.15 / off;
    }
  }
  bend(1) /= length;
  bend(2) /= length * length;
  if (!bend.allFinite()) return false;
  side.bend = bend;
  return true;
}

std::optional<Eigen::Vector2d> crossing(const Side& a, const Side& b, Eigen::Vector2d point) {
  for (int round = 0; round < 10; ++round) {
    Eigen::Matrix2d slope;
    Eigen::Vector2d off;
    int i = 0;
    for (const Side* side : {&a, &b}) {
      const double s = side->along.dot(point - side->origin);
      off(i) = side->across.dot(point - side->origin) -
               (side->bend(0) + side->bend(1) * s + side->bend(2) * s * s);
      slope.row(i++) = side->across.transpose() -
                       (side->bend(1) + 2 * side->bend(2) * s) * side->along.transpose();
    }
    if (std::abs(slope.determinant()) < 0.05) return std::nullopt;
    const Eigen::Vector2d step = slope.inverse() * off;
    point -= step;
    if (step.norm() < 1e-6) return point;
  }
  return std::nullopt;
}

void measureTags(const cv::Mat& fine, const Target& asked, const Expected& expected,
                 Measured& measured) {
  Target target = asked;
  if (target.border_bits == 0) target.border_bits = borderSeen(fine, target, expected);
  const int points_a_row = 2 * target.cols;
  const double border = borderShare(target);
  const bool joined = showsJoiningSquares(fine, target, expected);
  for (int row = 0; row < target.rows; ++row) {
    for (int col = 0; col < target.cols; ++col) {
      const int first = 2 * row * points_a_row + 2 * col;
      const std::array<int, 4> ids{first, first + 1, first + points_a_row + 1,
                                   first + points_a_row};
      if (!std::all_of(ids.begin(), ids.end(), [&](int id) { return expected[id].has_value(); })) {
        continue;
      }
      Eigen::Vector2d middle = Eigen::Vector2d::Zero();
      for (const int id : ids) middle += 0.25 * expected[id]->pixel;
      double axis = 1e300;
      for (const int id : ids) axis = std::min(axis, shorterAxis(expected[id]->jacobian));
      // The lines across a side stay within the black border and the gap.
      const double width = target.square_m * axis * std::min(border, target.spacing);
      const double half = std::clamp(0.9 * width, 1.5, 6.0);
      std::array<Side, 4> sides;
      std::array<bool, 4> fitted{};
      std::array<Eigen::Vector2d, 4> corners;
      for (int i = 0; i < 4; ++i) corners[i] = expected[ids[i]]->pixel;
      for (int i = 0; i < 4; ++i) sides[i] = chord(corners[i], corners[(i + 1) % 4], middle);
      // Again from where the round before says the sides are, so that the lines across are centred.
      for (int round = 0; round < 4; ++round) {
        for (int i = 0; i < 4; ++i) {
          const double begin = sides[i].along.dot(corners[i] - sides[i].origin);
          const double end = sides[i].along.dot(corners[(i + 1) % 4] - sides[i].origin);
          fitted[i] = fitSide(fine, begin, end, half, sides[i]);
        }
        for (int i = 0; i < 4; ++i) {
          const int before = (i + 3) % 4;
          if (!fitted[before] || !fitted[i]) continue;
          if (const auto point = crossing(sides[before], sides[i], corners[i])) corners[i] = *point;
        }
      }
      for (int i = 0; i < 4; ++i) {
        const int before = (i + 3) % 4;
        if (!fitted[before] || !fitted[i]) continue;
        const auto point = crossing(sides[before], sides[i], corners[i]);
        const LocalFrame& frame = *expected[ids[i]];
        if (!point || (*point - frame.pixel).norm() > std::max(2.0, 2.0 * width)) continue;
        if (!grayAt(fine, *point)) continue;
        measured[ids[i]] = *point;
        // The quadrant of the tag; with joining squares, the one across as well.
        constexpr unsigned kInside[4] = {kPlusPlus, kMinusPlus, kMinusMinus, kPlusMinus};
        const unsigned tag = kInside[i];
        const unsigned dark = joined ? tag | kInside[(i + 2) % 4] : tag;
        Clear clear = clearAround(target, dark);
        clear.coded = tag;
        const auto corner = fitCorner(fine, dark, clear, {*point, frame.jacobian});
        if (corner && (*corner - *point).norm() < 1.0) measured[ids[i]] = *corner;
      }
    }
  }
}

void measureDots(const cv::Mat& fine, const Target& target, const Expected& expected,
                 Measured& measured) {
  const double nearest = target.square_m * (target.asymmetric ? std::sqrt(2.0) : 1.0);
  const double reach = 0.48 * nearest;
  for (std::size_t id = 0; id < expected.size(); ++id) {
    if (!expected[id]) continue;
    const Eigen::Matrix2d jacobian = expected[id]->jacobian * reach;
    if (!(std::abs(jacobian.determinant()) > 4.0)) continue;
    const Eigen::Matrix2d inverse = jacobian.inverse();
    Eigen::Vector2d pixel = expected[id]->pixel;
    bool good = false;
    for (int round = 0; round < 5; ++round) {
      good = false;
      // White is half way to the neighbours, whatever the size of the dots.
      std::vector<double> rim;
      for (int k = 0; k < 32; ++k) {
        const double angle = 2.0 * M_PI * k / 32;
        const Eigen::Vector2d direction(std::cos(angle), std::sin(angle));
        if (const auto gray = grayAt(fine, pixel + jacobian * direction)) rim.push_back(*gray);
      }
      const auto heart = grayAt(fine, pixel);
      if (rim.size() < 32 || !heart) break;
      std::nth_element(rim.begin(), rim.begin() + 16, rim.end());
      const double white = rim[16];
      double spread = 0.0;
      for (const double gray : rim) spread += std::abs(gray - white) / rim.size();
      if (white - *heart < kMinDotContrast * (spread + 2.0)) break;
      const double width = std::abs(jacobian(0, 0)) + std::abs(jacobian(0, 1));
      const double height = std::abs(jacobian(1, 0)) + std::abs(jacobian(1, 1));
      double weight = 0.0;
      Eigen::Vector2d moment = Eigen::Vector2d::Zero();
      for (int y = static_cast<int>(std::ceil(pixel.y() - height)); y <= pixel.y() + height; ++y) {
        for (int x = static_cast<int>(std::ceil(pixel.x() - width)); x <= pixel.x() + width; ++x) {
          const Eigen::Vector2d place(x, y);
          if ((inverse * (place - pixel)).squaredNorm() > 1.0) continue;
          const auto gray = grayAt(fine, place);
          if (!gray) continue;
          const double dark = std::clamp((white - *gray) / (white - *heart), 0.0, 1.0);
          if (dark < 0.08) continue;
          weight += dark;
          moment += dark * place;
        }
      }
      if (weight < 3.0) break;
      const Eigen::Vector2d next = moment / weight;
      good = true;
      const bool settled = (next - pixel).norm() < 1e-3;
      pixel = next;
      if (settled) break;
    }
    const double spacing = shorterAxis(expected[id]->jacobian) * nearest;
    if (!good || (pixel - expected[id]->pixel).norm() > std::max(2.0, 0.25 * spacing)) continue;
    measured[id] = pixel;
  }
}

}  // namespace

Measured measurePoints(const cv::Mat& fine, const Target& target, const Expected& expected,
                       bool first_square_dark) {
  Measured measured(expected.size());
  switch (target.type) {
    case TargetType::kCheckerboard:
    case TargetType::kCharuco:
      measureCorners(fine, target, expected, first_square_dark, measured);
      break;
    case TargetType::kAprilGrid:
      measureTags(fine, target, expected, measured);
      break;
    case TargetType::kCircles:
      measureDots(fine, target, expected, measured);
      break;
  }
  return measured;
}

Expected framesFromGrid(const Measured& points, const Target& target) {
  const Eigen::Vector2i grid = targetGrid(target);
  const std::vector<Eigen::Vector3d> board = targetPoints(target);
  Expected frames(points.size());
  const auto known = [&](int col, int row) {
    return col >= 0 && row >= 0 && col < grid.x() && row < grid.y() &&
           points[row * grid.x() + col].has_value();
  };
  for (int row = 0; row < grid.y(); ++row) {
    for (int col = 0; col < grid.x(); ++col) {
      if (!known(col, row)) continue;
      // Least squares over the neighbours: asymmetric dots have theirs aslant.
      Eigen::Matrix2d board_sum = Eigen::Matrix2d::Zero();
      Eigen::Matrix2d pixel_sum = Eigen::Matrix2d::Zero();
      const int id = row * grid.x() + col;
      for (int down = -1; down <= 1; ++down) {
        for (int right = -1; right <= 1; ++right) {
          if ((down == 0 && right == 0) || !known(col + right, row + down)) continue;
          const int other = (row + down) * grid.x() + col + right;
          const Eigen::Vector2d b = (board[other] - board[id]).head<2>();
          const Eigen::Vector2d p = *points[other] - *points[id];
          board_sum += b * b.transpose();
          pixel_sum += p * b.transpose();
        }
      }
      if (board_sum.determinant() < 1e-3 * std::pow(board_sum.trace(), 2)) continue;
      frames[id] = LocalFrame{*points[id], pixel_sum * board_sum.inverse()};
    }
  }
  return frames;
}

double firstSquareContrast(const cv::Mat& fine, const Target& target, const Expected& points) {
  double sum = 0.0;
  int count = 0;
  for (std::size_t id = 0; id < points.size(); ++id) {
    if (!points[id]) continue;
    sum += cornerContrast(fine, *points[id], darkQuadrants(target, static_cast<int>(id), true),
                          0.8 * clearReach(target));
    ++count;
  }
  return count > 0 ? sum / count : 0.0;
}

std::optional<LocalFrame> frameFromMarker(const Marker& marker, const Eigen::Vector2d& board) {
  // The homography through the four corners, about the marker's middle for good numbers.
  const Eigen::Vector2d middle =
      0.25 * (marker.board[0] + marker.board[1] + marker.board[2] + marker.board[3]);
  const double size = (marker.board[2] - marker.board[0]).norm();
  Eigen::Matrix<double, 8, 8> system;
  Eigen::Matrix<double, 8, 1> right;
  for (int i = 0; i < 4; ++i) {
    const Eigen::Vector2d b = (marker.board[i] - middle) / size;
    const Eigen::Vector2d p = marker.pixels[i] - marker.pixels[0];
    system.row(2 * i) << b.x(), b.y(), 1, 0, 0, 0, -p.x() * b.x(), -p.x() * b.y();
    system.row(2 * i + 1) << 0, 0, 0, b.x(), b.y(), 1, -p.y() * b.x(), -p.y() * b.y();
    right.segment<2>(2 * i) = p;
  }
  const Eigen::Matrix<double, 8, 1> h = system.fullPivLu().solve(right);
  const Eigen::Vector2d b = (board - middle) / size;
  const double w = h(6) * b.x() + h(7) * b.y() + 1.0;
  if (!h.allFinite() || !(w > 0.1)) return std::nullopt;
  const Eigen::Vector2d pixel(h(0) * b.x() + h(1) * b.y() + h(2),
                              h(3) * b.x() + h(4) * b.y() + h(5));
  LocalFrame frame;
  frame.pixel = pixel / w + marker.pixels[0];
  frame.jacobian << h(0) - pixel.x() / w * h(6), h(1) - pixel.x() / w * h(7),
      h(3) - pixel.y() / w * h(6), h(4) - pixel.y() / w * h(7);
  frame.jacobian /= w * size;
  return frame;
}

void addNew(const std::vector<Marker>& found, std::vector<Marker>& markers) {
  for (const Marker& marker : found) {
    const bool known = std::any_of(markers.begin(), markers.end(),
                                   [&](const Marker& other) { return other.id == marker.id; });
    if (!known) markers.push_back(marker);
  }
}

std::vector<Marker> consistentMarkers(const std::vector<Marker>& markers) {
  const auto middle = [](const std::vector<Eigen::Vector2d>& corners) -> Eigen::Vector2d {
    return 0.25 * (corners[0] + corners[1] + corners[2] + corners[3]);
  };
  // Linear extrapolation over one or two cells is good to a third even at the rim of a fisheye.
  const auto agrees = [&](const Marker& from, const Marker& to) {
    const auto frame = frameFromMarker(from, middle(from.board));
    if (!frame) return false;
    const Eigen::Vector2d step = frame->jacobian * (middle(to.board) - middle(from.board));
    const Eigen::Vector2d seen = middle(to.pixels) - frame->pixel;
    return (seen - step).norm() < 0.4 * std::max(step.norm(), seen.norm());
  };
  std::vector<int> support(markers.size(), 0);
  std::vector<int> against(markers.size(), 0);
  for (std::size_t i = 0; i < markers.size(); ++i) {
    for (std::size_t j = 0; j < markers.size(); ++j) {
      if (i == j || (markers[i].cell - markers[j].cell).cwiseAbs().maxCoeff() > 2) continue;
      const bool same = markers[i].id != markers[j].id && agrees(markers[i], markers[j]) &&
                        agrees(markers[j], markers[i]);
      (same ? support : against)[i] += 1;
    }
  }
  std::vector<Marker> kept;
  for (std::size_t i = 0; i < markers.size(); ++i) {
    // One alone stands or falls by its code; one among others needs most of them.
    const bool alone = markers.size() == 1;
    if (alone || support[i] > against[i]) kept.push_back(markers[i]);
  }
  return kept;
}

}  // namespace omnister::detect
