// SPDX-License-Identifier: Apache-2.0
#include "calibration/detect/tag_alignment.h"

#include <Eigen/Dense>
#include <algorithm>
#include <array>
#include <cmath>
#include <map>
#include <opencv2/imgproc.hpp>
#include <utility>

#include "calibration/target/tag_families.h"

namespace omnister::detect {
namespace {

using Corners = std::vector<Eigen::Vector2d>;

/// From (u, v) in [0, 1] over the tag to the picture, through its four corners.
class TagMap {
 public:
  explicit TagMap(const Corners& corners) {
    // Heckbert 1989, sec. 2.2.3: the unit square to a quadrilateral.
    const Eigen::Vector2d& a = corners[0];
    const Eigen::Vector2d& b = corners[1];
    const Eigen::Vector2d& c = corners[2];
    const Eigen::Vector2d& d = corners[3];
    const Eigen::Vector2d s = a - b + c - d;
    Eigen::Matrix2d sides;
    sides.col(0) = b - c;
    sides.col(1) = d - c;
    const double area = sides.determinant();
    const Eigen::Vector2d gh =
        std::abs(area) > 1e-9 ? Eigen::Vector2d(sides.inverse() * s) : Eigen::Vector2d::Zero();
    matrix_.col(0) << b - a + gh.x() * b, gh.x();
    matrix_.col(1) << d - a + gh.y() * d, gh.y();
    matrix_.col(2) << a, 1.0;
  }

  Eigen::Vector2d operator()(double u, double v) const {
    return (matrix_ * Eigen::Vector3d(u, v, 1.0)).hnormalized();
  }

 private:
  Eigen::Matrix3d matrix_;
};

double shortestSide(const Corners& corners) {
  double least = 1e300;
  for (int i = 0; i < 4; ++i) {
    least = std::min(least, (corners[(i + 1) % 4] - corners[i]).norm());
  }
  return least;
}

double area(const Corners& corners) {
  double twice = 0.0;
  for (int i = 0; i < 4; ++i) {
    const Eigen::Vector2d& a = corners[i];
    const Eigen::Vector2d& b = corners[(i + 1) % 4];
    twice += a.x() * b.y() - a.y() * b.x();
  }
  return 0.5 * twice;
}

bool turnsRight(const Corners& corners) {
  for (int i = 0; i < 4; ++i) {
    const Eigen::Vector2d a = corners[(i + 1) % 4] - corners[i];
    const Eigen::Vector2d b = corners[(i + 2) % 4] - corners[(i + 1) % 4];
    if (!(a.x() * b.y() - a.y() * b.x() > 0.0)) return false;
  }
  return true;
}

/// A tag's drawing, blurred as the picture is.
class Drawing {
 public:
  /// @param blur standard deviation [cells]
  Drawing(const cv::Mat& bits, double blur) : cells_(bits.cols) {
    cv::Mat framed;
    cv::copyMakeBorder(bits, framed, kFrame, kFrame, kFrame, kFrame, cv::BORDER_CONSTANT,
                       cv::Scalar(255));
    cv::resize(framed, fine_, {}, kPixels, kPixels, cv::INTER_NEAREST);
    fine_.convertTo(fine_, CV_32F, 1.0 / 255.0);
    const double sigma = blur * kPixels;
    if (sigma > 0.3) cv::GaussianBlur(fine_, fine_, {}, sigma, sigma, cv::BORDER_REPLICATE);
  }

  int cells() const { return cells_; }

  double at(double u, double v) const {
    return grayAt(fine_,
                  {(u * cells_ + kFrame) * kPixels - 0.5, (v * cells_ + kFrame) * kPixels - 0.5})
        .value_or(1.0);
  }

 private:
  static constexpr int kFrame = 3;   // white around the tag [cells]
  static constexpr int kPixels = 6;  // a cell
  int cells_;
  cv::Mat fine_;
};

struct Sample {
  double u, v, drawn;
  bool code;
};

/// Places over the tag and a little beyond its sides, not beyond its corners, where squares that
/// join the tags may be.
std::vector<Sample> samplesOf(const Drawing& drawing, double side_px, int border_bits) {
  const int cells = drawing.cells();
  const double out = 1.0;  // beyond the sides [cells]
  const int count = std::clamp(
      static_cast<int>(std::lround(1.4 * side_px * (cells + 2 * out) / cells)), 2 * cells, 56);
  std::vector<Sample> samples;
  for (int j = 0; j < count; ++j) {
    for (int i = 0; i < count; ++i) {
      const double x = -out + (cells + 2 * out) * (i + 0.5) / count;
      const double y = -out + (cells + 2 * out) * (j + 0.5) / count;
      const bool beside_x = x < 0.0 || x > cells;
      const bool beside_y = y < 0.0 || y > cells;
      if (beside_x && beside_y) continue;
      const double u = x / cells;
      const double v = y / cells;
      const bool code = std::min({x, y, cells - x, cells - y}) > border_bits;
      samples.push_back({u, v, drawing.at(u, v), code});
    }
  }
  return samples;
}

struct Likeness {
  double whole = -1.0;
  double code = -1.0;
};

double correlation(double n, double a, double b, double aa, double bb, double ab) {
  const double va = aa - a * a / n;
  const double vb = bb - b * b / n;
  return va > 1e-9 && vb > 1e-9 ? (ab - a * b / n) / std::sqrt(va * vb) : 0.0;
}

std::optional<Likeness> likenessOf(const cv::Mat& fine, const std::vector<Sample>& samples,
                                   const Corners& corners) {
  const TagMap map(corners);
  std::array<std::array<double, 6>, 2> sums{};
  for (const Sample& sample : samples) {
    const auto gray = grayAt(fine, map(sample.u, sample.v));
    if (!gray) return std::nullopt;
    for (int set = 0; set < (sample.code ? 2 : 1); ++set) {
      auto& s = sums[static_cast<std::size_t>(set)];
      s[0] += 1.0;
      s[1] += sample.drawn;
      s[2] += *gray;
      s[3] += sample.drawn * sample.drawn;
      s[4] += *gray * *gray;
      s[5] += sample.drawn * *gray;
    }
  }
  const auto of = [&](const std::array<double, 6>& s) {
    return s[0] > 3.0 ? correlation(s[0], s[1], s[2], s[3], s[4], s[5]) : 0.0;
  };
  return Likeness{of(sums[0]), of(sums[1])};
}

/// Gauss-Newton on the corners: picture = bright + contrast * drawing.
bool settle(const cv::Mat& fine, const std::vector<Sample>& samples, int rounds, double reach,
            Corners& corners) {
  const Corners start = corners;
  for (int round = 0; round < rounds; ++round) {
    const TagMap map(corners);
    // Unknowns: 8 of the corners, brightness and contrast.
    Eigen::Matrix<double, 10, 10> normal = Eigen::Matrix<double, 10, 10>::Zero();
    Eigen::Matrix<double, 10, 1> right = Eigen::Matrix<double, 10, 1>::Zero();
    std::size_t inside = 0;
    for (const Sample& s : samples) {
      const Eigen::Vector2d place = map(s.u, s.v);
      const auto gray = grayAt(fine, place);
      const auto left_of = grayAt(fine, place - Eigen::Vector2d(0.5, 0.0));
      const auto right_of = grayAt(fine, place + Eigen::Vector2d(0.5, 0.0));
      const auto above = grayAt(fine, place - Eigen::Vector2d(0.0, 0.5));
      const auto below = grayAt(fine, place + Eigen::Vector2d(0.0, 0.5));
      if (!gray || !left_of || !right_of || !above || !below) continue;
      ++inside;
      const Eigen::Vector2d slope(*right_of - *left_of, *below - *above);
      const std::array<double, 4> weight = {(1 - s.u) * (1 - s.v), s.u * (1 - s.v), s.u * s.v,
                                            (1 - s.u) * s.v};
      Eigen::Matrix<double, 10, 1> row;
      for (std::size_t k = 0; k < 4; ++k)
        row.segment<2>(2 * static_cast<long>(k)) = -weight[k] * slope;
      row(8) = 1.0;
      row(9) = s.drawn;
      normal.selfadjointView<Eigen::Lower>().rankUpdate(row);
      right += *gray * row;
    }
    if (10 * inside < 9 * samples.size()) return false;
    // Held to where it is by a hair, since a side seen end on pulls no corner along it.
    normal.diagonal().head<8>().array() += 1e-3 * normal.diagonal().head<8>().mean() + 1e-9;
    normal.diagonal().tail<2>().array() += 1e-9;
    const Eigen::Matrix<double, 10, 1> step =
        normal.selfadjointView<Eigen::Lower>().ldlt().solve(right);
    // Dark tags on white, never the other way round.
    if (!step.allFinite() || !(step(9) > 0.0)) return false;
    double moved = 0.0;
    for (int k = 0; k < 4; ++k) {
      Eigen::Vector2d move = step.segment<2>(2 * k);
      if (move.norm() > 0.5 * reach) move *= 0.5 * reach / move.norm();
      corners[static_cast<std::size_t>(k)] += move;
      moved = std::max(moved, move.norm());
      if ((corners[static_cast<std::size_t>(k)] - start[static_cast<std::size_t>(k)]).norm() >
          reach) {
        return false;
      }
    }
    if (moved < 0.01) break;
  }
  return turnsRight(corners);
}

/// The part of the picture around a tag, as floats; corners become those of the part.
cv::Mat partAround(const cv::Mat& fine, double margin, Corners& corners, Eigen::Vector2d& origin) {
  Eigen::Vector2d low = corners[0];
  Eigen::Vector2d high = corners[0];
  for (const Eigen::Vector2d& corner : corners) {
    low = low.cwiseMin(corner);
    high = high.cwiseMax(corner);
  }
  const int left = std::max(0, static_cast<int>(std::floor(low.x() - margin)));
  const int top = std::max(0, static_cast<int>(std::floor(low.y() - margin)));
  const int right = std::min(fine.cols, static_cast<int>(std::ceil(high.x() + margin)) + 1);
  const int bottom = std::min(fine.rows, static_cast<int>(std::ceil(high.y() + margin)) + 1);
  cv::Mat part;
  if (right - left < 4 || bottom - top < 4) return part;
  fine(cv::Rect(left, top, right - left, bottom - top)).convertTo(part, CV_32F);
  origin = {left, top};
  for (Eigen::Vector2d& corner : corners) corner -= origin;
  return part;
}

// What a lens and its sensor blur by, at least; the drawing is blurred alike [px].
constexpr double kPictureBlur = 0.7;

}  // namespace

std::optional<AlignedTag> alignTag(const cv::Mat& fine, const cv::Mat& bits, int border_bits,
                                   const Corners& start) {
  const double side = shortestSide(start);
  if (!(side > 5.0) || !(side < 2000.0) || !turnsRight(start)) return std::nullopt;
  Corners corners = start;
  Eigen::Vector2d origin;
  const cv::Mat part = partAround(fine, 0.4 * side + 4.0, corners, origin);
  if (part.empty()) return std::nullopt;
  const double mean_side = std::sqrt(std::abs(area(start)));
  const double cell = mean_side / bits.cols;
  // A large tag needs no finer look than about 4 px a cell.
  const double coarse = 1.2 * cell;
  cv::Mat blurred;
  cv::GaussianBlur(part, blurred, {}, coarse, coarse, cv::BORDER_REPLICATE);
  const Drawing rough(bits, std::hypot(coarse, kPictureBlur) / cell);
  const Drawing sharp(bits, std::max(kPictureBlur / cell, 0.12));
  if (!settle(blurred, samplesOf(rough, 0.7 * mean_side, border_bits), 12, 0.35 * mean_side,
              corners)) {
    return std::nullopt;
  }
  const std::vector<Sample> samples = samplesOf(sharp, mean_side, border_bits);
  if (!settle(part, samples, 12, 0.2 * mean_side, corners)) return std::nullopt;
  const auto likeness = likenessOf(part, samples, corners);
  if (!likeness) return std::nullopt;
  AlignedTag tag;
  tag.likeness = likeness->whole;
  tag.code_likeness = likeness->code;
  for (const Eigen::Vector2d& corner : corners) tag.pixels.push_back(corner + origin);
  return tag;
}

namespace {

constexpr double kLikeness = 0.75;      ///< of a tag where its neighbours say it is
constexpr double kCodeLikeness = 0.5;   ///< of its bits
constexpr double kToldLikeness = 0.65;  ///< of the bits of a tag from anywhere
constexpr double kLead = 0.15;          ///< by which it leads all other codes

int keyOf(const Eigen::Vector2i& cell) { return cell.y() * 1000 + cell.x(); }

/// Where a tag's corners should be: lines and parabolas through those of tags in one line with it.
std::optional<Corners> predicted(const std::map<int, const Marker*>& known,
                                 const Eigen::Vector2i& cell,
                                 const std::vector<Eigen::Vector2d>& board) {
  const auto at = [&](int steps, const Eigen::Vector2i& way) -> const Marker* {
    const Eigen::Vector2i place = cell + steps * way;
    if (place.minCoeff() < 0) return nullptr;
    const auto found = known.find(keyOf(place));
    return found == known.end() ? nullptr : found->second;
  };
  Corners sum(4, Eigen::Vector2d::Zero());
  double weights = 0.0;
  const auto add = [&](double weight, const auto& corner) {
    for (std::size_t k = 0; k < 4; ++k) sum[k] += weight * corner(k);
    weights += weight;
  };
  for (int y = -1; y <= 1; ++y) {
    for (int x = -1; x <= 1; ++x) {
      const Eigen::Vector2i way(x, y);
      if (x == 0 && y == 0) continue;
      const Marker* first = at(1, way);
      if (first == nullptr) continue;
      const Marker* second = at(2, way);
      const Marker* third = at(3, way);
      const Marker* behind = at(-1, way);
      // Diagonals are longer.
      const double trust = x != 0 && y != 0 ? 0.5 : 1.0;
      if (behind != nullptr) {
        add(4.0 * trust, [&](std::size_t k) -> Eigen::Vector2d {
          return 0.5 * (first->pixels[k] + behind->pixels[k]);
        });
      } else if (second != nullptr && third != nullptr) {
        add(3.0 * trust, [&](std::size_t k) -> Eigen::Vector2d {
          return 3.0 * first->pixels[k] - 3.0 * second->pixels[k] + third->pixels[k];
        });
      } else if (second != nullptr) {
        add(2.0 * trust, [&](std::size_t k) -> Eigen::Vector2d {
          return 2.0 * first->pixels[k] - second->pixels[k];
        });
      } else {
        bool fine = true;
        Corners corners(4, Eigen::Vector2d::Zero());
        for (std::size_t k = 0; k < 4 && fine; ++k) {
          const auto frame = frameFromMarker(*first, board[k]);
          fine = frame.has_value();
          if (fine) corners[k] = frame->pixel;
        }
        if (fine) add(0.3 * trust, [&](std::size_t k) { return corners[k]; });
      }
    }
  }
  if (!(weights > 0.0)) return std::nullopt;
  for (Eigen::Vector2d& corner : sum) corner /= weights;
  return sum;
}

bool inside(const cv::Mat& image, const Corners& corners) {
  return std::all_of(corners.begin(), corners.end(), [&](const Eigen::Vector2d& corner) {
    return corner.x() > 1 && corner.y() > 1 && corner.x() < image.cols - 2 &&
           corner.y() < image.rows - 2;
  });
}

}  // namespace

std::vector<Marker> growAprilGrid(const cv::Mat& fine, const Target& target,
                                  const std::vector<Marker>& known, const Budget& budget) {
  std::vector<Marker> places;
  for (int id = 0; id < target.cols * target.rows; ++id) {
    places.emplace_back().id = id;
    places.back().border_bits = target.border_bits;
    places.back().pixels.resize(4);
  }
  places = placeAprilGrid(places, target);
  std::vector<Marker> all = known;
  std::map<int, std::size_t> tried;  // cell to how many tags were known when it was looked for
  for (int round = 0; round < target.cols + target.rows; ++round) {
    std::map<int, const Marker*> at;
    for (const Marker& marker : all) at[keyOf(marker.cell)] = &marker;
    std::vector<Marker> found;
    for (const Marker& place : places) {
      const int key = keyOf(place.cell);
      if (at.count(key) > 0 || budget.spent()) continue;
      const auto start = predicted(at, place.cell, place.board);
      if (!start || !inside(fine, *start)) continue;
      std::size_t neighbours = 0;
      for (const Marker& marker : all) {
        neighbours += (marker.cell - place.cell).cwiseAbs().maxCoeff() <= 3;
      }
      if (tried.count(key) > 0 && tried[key] == neighbours) continue;
      tried[key] = neighbours;
      const cv::Mat bits = tags::aprilBits(target.dictionary, place.id, target.border_bits);
      const auto tag = alignTag(fine, bits, target.border_bits, *start);
      if (!tag || tag->likeness < kLikeness || tag->code_likeness < kCodeLikeness) continue;
      found.push_back(place);
      found.back().pixels = tag->pixels;
    }
    if (found.empty()) break;
    all.insert(all.end(), found.begin(), found.end());
  }
  return all;
}

namespace {

/// Codes of a family as the bits stand on the tag, row by row, each turned four ways.
struct Codes {
  int side = 0;
  /// [id][turn]: zero mean, unit length
  std::vector<std::array<Eigen::VectorXd, 4>> bits;
};

Codes codesOf(const Target& target) {
  Codes codes;
  for (int id = 0; id < target.cols * target.rows; ++id) {
    const cv::Mat tag = tags::aprilBits(target.dictionary, id, 1);
    cv::Mat inner = tag(cv::Rect(1, 1, tag.cols - 2, tag.rows - 2)).clone();
    codes.side = inner.cols;
    auto& turns = codes.bits.emplace_back();
    for (Eigen::VectorXd& turn : turns) {
      turn.resize(inner.cols * inner.rows);
      for (int i = 0; i < turn.size(); ++i) {
        turn[i] = inner.at<uchar>(i / inner.cols, i % inner.cols);
      }
      turn.array() -= turn.mean();
      turn /= std::max(turn.norm(), 1e-9);
      cv::rotate(inner, inner, cv::ROTATE_90_CLOCKWISE);
    }
  }
  return codes;
}

/// Grey over the bits of a tag, zero mean and unit length.
std::optional<Eigen::VectorXd> bitsSeen(const cv::Mat& fine, const Corners& corners, int side,
                                        int border_bits) {
  const TagMap map(corners);
  const double cells = side + 2 * border_bits;
  Eigen::VectorXd seen = Eigen::VectorXd::Zero(side * side);
  for (int row = 0; row < side; ++row) {
    for (int col = 0; col < side; ++col) {
      for (const double down : {0.3, 0.7}) {
        for (const double along : {0.3, 0.7}) {
          const auto gray = grayAt(
              fine, map((border_bits + col + along) / cells, (border_bits + row + down) / cells));
          if (!gray) return std::nullopt;
          seen[row * side + col] += *gray;
        }
      }
    }
  }
  seen.array() -= seen.mean();
  if (!(seen.norm() > 4.0 * side)) return std::nullopt;
  return Eigen::VectorXd(seen / seen.norm());
}

}  // namespace

std::vector<Marker> tellTags(const cv::Mat& fine, const Target& target,
                             const std::vector<Corners>& quads,
                             const std::vector<int>& border_bits) {
  const Codes codes = codesOf(target);
  std::vector<Marker> told;
  for (const Corners& quad : quads) {
    Corners corners = quad;
    if (area(corners) < 0.0) std::reverse(corners.begin(), corners.end());
    if (!turnsRight(corners) || !inside(fine, corners) || shortestSide(corners) < 7.0) continue;
    struct Best {
      double likeness = 0.0;
      int id = -1;
      int turn = 0;
      int border = 1;
    };
    Best best;
    double second = 0.0;
    for (const int border : border_bits) {
      const auto seen = bitsSeen(fine, corners, codes.side, border);
      if (!seen) continue;
      for (std::size_t id = 0; id < codes.bits.size(); ++id) {
        for (int turn = 0; turn < 4; ++turn) {
          const double likeness = seen->dot(codes.bits[id][static_cast<std::size_t>(turn)]);
          if (likeness > best.likeness) {
            if (best.id != static_cast<int>(id)) second = best.likeness;
            best = {likeness, static_cast<int>(id), turn, border};
          } else if (best.id != static_cast<int>(id)) {
            second = std::max(second, likeness);
          }
        }
      }
    }
    if (best.likeness < kToldLikeness || best.likeness - second < kLead) continue;
    // Turned clockwise by `turn` quarters, the tag's top left corner is the quad's corner `turn`.
    Corners start;
    for (int k = 0; k < 4; ++k)
      start.push_back(corners[static_cast<std::size_t>((k + best.turn) % 4)]);
    const cv::Mat bits = tags::aprilBits(target.dictionary, best.id, best.border);
    const auto tag = alignTag(fine, bits, best.border, start);
    if (!tag || tag->likeness < kLikeness || tag->code_likeness < kToldLikeness) continue;
    Marker marker;
    marker.id = best.id;
    marker.border_bits = best.border;
    marker.pixels = tag->pixels;
    addNew({marker}, told);
  }
  return told;
}

}  // namespace omnister::detect
