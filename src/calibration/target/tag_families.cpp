// SPDX-License-Identifier: Apache-2.0
#include "calibration/target/tag_families.h"

#include <apriltag/tag16h5.h>
#include <apriltag/tag25h9.h>
#include <apriltag/tag36h10.h>
#include <apriltag/tag36h11.h>

#include <array>
#include <cstdint>
#include <utility>

namespace omnister::tags {
namespace {

constexpr std::array<std::pair<const char*, int>, 21> kDictionaries{{
    {"DICT_4X4_50", cv::aruco::DICT_4X4_50},
    {"DICT_4X4_100", cv::aruco::DICT_4X4_100},
    {"DICT_4X4_250", cv::aruco::DICT_4X4_250},
    {"DICT_4X4_1000", cv::aruco::DICT_4X4_1000},
    {"DICT_5X5_50", cv::aruco::DICT_5X5_50},
    {"DICT_5X5_100", cv::aruco::DICT_5X5_100},
    {"DICT_5X5_250", cv::aruco::DICT_5X5_250},
    {"DICT_5X5_1000", cv::aruco::DICT_5X5_1000},
    {"DICT_6X6_50", cv::aruco::DICT_6X6_50},
    {"DICT_6X6_100", cv::aruco::DICT_6X6_100},
    {"DICT_6X6_250", cv::aruco::DICT_6X6_250},
    {"DICT_6X6_1000", cv::aruco::DICT_6X6_1000},
    {"DICT_7X7_50", cv::aruco::DICT_7X7_50},
    {"DICT_7X7_100", cv::aruco::DICT_7X7_100},
    {"DICT_7X7_250", cv::aruco::DICT_7X7_250},
    {"DICT_7X7_1000", cv::aruco::DICT_7X7_1000},
    {"DICT_ARUCO_ORIGINAL", cv::aruco::DICT_ARUCO_ORIGINAL},
    {"DICT_APRILTAG_16h5", cv::aruco::DICT_APRILTAG_16h5},
    {"DICT_APRILTAG_25h9", cv::aruco::DICT_APRILTAG_25h9},
    {"DICT_APRILTAG_36h10", cv::aruco::DICT_APRILTAG_36h10},
    {"DICT_APRILTAG_36h11", cv::aruco::DICT_APRILTAG_36h11},
}};

struct FamilyFunctions {
  const char* name;
  apriltag_family_t* (*create)();
  void (*destroy)(apriltag_family_t*);
};
constexpr std::array<FamilyFunctions, 4> kFamilies{{
    {"tag36h11", tag36h11_create, tag36h11_destroy},
    {"tag36h10", tag36h10_create, tag36h10_destroy},
    {"tag25h9", tag25h9_create, tag25h9_destroy},
    {"tag16h5", tag16h5_create, tag16h5_destroy},
}};

}  // namespace

cv::Ptr<cv::aruco::Dictionary> arucoDictionary(const std::string& name) {
  for (const auto& [known, id] : kDictionaries) {
    if (name == known) return cv::aruco::getPredefinedDictionary(id);
  }
  return nullptr;
}

std::string arucoDictionaryNames() {
  return "DICT_{4X4,5X5,6X6,7X7}_{50,100,250,1000}, DICT_ARUCO_ORIGINAL, "
         "DICT_APRILTAG_{16h5,25h9,36h10,36h11}";
}

cv::Mat arucoBits(const std::string& dictionary, int id) {
  const auto markers = arucoDictionary(dictionary);
  cv::Mat bits;
  markers->drawMarker(id, markers->markerSize + 2, bits, 1);
  return bits;
}

AprilFamily aprilFamily(const std::string& name, int border_bits) {
  for (const FamilyFunctions& family : kFamilies) {
    if (name != family.name) continue;
    AprilFamily tags(family.create(), family.destroy);
    // The same codes inside a wider frame.
    const int wider = border_bits - 1;
    tags->width_at_border += 2 * wider;
    tags->total_width += 2 * wider;
    for (std::uint32_t bit = 0; bit < tags->nbits; ++bit) {
      tags->bit_x[bit] += wider;
      tags->bit_y[bit] += wider;
    }
    return tags;
  }
  return nullptr;
}

std::string aprilFamilyNames() {
  std::string names;
  for (const FamilyFunctions& family : kFamilies) {
    names += (names.empty() ? "" : ", ") + std::string(family.name);
  }
  return names;
}

cv::Mat aprilBits(const std::string& family, int id, int border_bits) {
  const AprilFamily tags = aprilFamily(family, border_bits);
  // The outline is one cell inside the drawing: white, the black border, the bits.
  const std::unique_ptr<image_u8_t, void (*)(image_u8_t*)> image(apriltag_to_image(tags.get(), id),
                                                                 image_u8_destroy);
  const cv::Mat whole(image->height, image->width, CV_8UC1, image->buf, image->stride);
  const int rim = (tags->total_width - tags->width_at_border) / 2;
  return whole(cv::Rect(rim, rim, tags->width_at_border, tags->width_at_border)).clone();
}

bool charucoBlack(const Target& target, int col, int row) {
  const int first = target.legacy ? target.rows - 1 : 0;
  return (col + row + first) % 2 == 0;
}

std::vector<Eigen::Vector2i> charucoMarkers(const Target& target) {
  std::vector<Eigen::Vector2i> markers;
  for (int row = 0; row < target.rows; ++row) {
    for (int col = 0; col < target.cols; ++col) {
      if (!charucoBlack(target, col, row)) markers.emplace_back(col, row);
    }
  }
  return markers;
}

}  // namespace omnister::tags
