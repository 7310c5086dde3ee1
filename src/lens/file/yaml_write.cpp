// SPDX-License-Identifier: Apache-2.0
#include "lens/file/yaml_write.h"

#include <algorithm>

#include "omnister/common/numbers.h"

namespace omnister::detail {
namespace {

std::string matrixBlock(const std::string& key, int rows, int cols, const std::string& data) {
  return key + ":\n  rows: " + std::to_string(rows) + "\n  cols: " + std::to_string(cols) +
         "\n  data: " + data + "\n";
}

}  // namespace

std::string yamlNumber(double value) {
  // YAML 1.1 readers take 1e-05 for text: they want a point in it.
  std::string out = formatNumber(value);
  const std::size_t exponent = out.find('e');
  if (exponent != std::string::npos && out.find('.') == std::string::npos) {
    out.insert(exponent, ".0");
  }
  return out;
}

std::string yamlFlow(const std::vector<double>& numbers) {
  std::string out = "[";
  for (const double value : numbers) {
    if (out.size() > 1) out += ", ";
    out += yamlNumber(value);
  }
  return out + "]";
}

std::string yamlRowMajor(const Eigen::MatrixXd& matrix) {
  std::vector<double> out;
  for (int i = 0; i < matrix.rows(); ++i) {
    for (int j = 0; j < matrix.cols(); ++j) out.push_back(matrix(i, j));
  }
  return yamlFlow(out);
}

std::string yamlText(const std::string& text) {
  const auto letter = [](char c) {
    return (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || c == '_';
  };
  static const std::vector<std::string> kReserved{"null", "true", "false", "yes", "no", "on",
                                                  "off",  "y",    "n",     "nan", "inf"};
  std::string lower;
  bool plain = !text.empty() && letter(text[0]);
  for (const char c : text) {
    plain = plain && (letter(c) || (c >= '0' && c <= '9') || c == '-' || c == '.' || c == '/');
    lower += static_cast<char>(c >= 'A' && c <= 'Z' ? c - 'A' + 'a' : c);
  }
  if (plain && std::find(kReserved.begin(), kReserved.end(), lower) == kReserved.end()) return text;
  std::string out = "\"";
  static constexpr char kHex[] = "0123456789ABCDEF";
  for (const char c : text) {
    const auto byte = static_cast<unsigned char>(c);
    if (c == '"' || c == '\\') {
      out += '\\';
      out += c;
    } else if (byte < 0x20 || byte == 0x7F) {
      out += "\\x";
      out += kHex[byte >> 4];
      out += kHex[byte & 15];
    } else {
      out += c;
    }
  }
  return out + "\"";
}

std::string cameraInfoText(cv::Size image_size, const std::string& camera_name,
                           const StandardCameraInfo& info) {
  Eigen::Matrix<double, 3, 4> P = Eigen::Matrix<double, 3, 4>::Zero();
  P.leftCols<3>() = info.K;
  return "image_width: " + std::to_string(image_size.width) +
         "\nimage_height: " + std::to_string(image_size.height) +
         "\ncamera_name: " + yamlText(camera_name) + "\n" +
         matrixBlock("camera_matrix", 3, 3, yamlRowMajor(info.K)) +
         "distortion_model: " + yamlText(info.distortion_model) + "\n" +
         matrixBlock("distortion_coefficients", 1, static_cast<int>(info.D.size()),
                     yamlFlow(info.D)) +
         matrixBlock("rectification_matrix", 3, 3, yamlRowMajor(Eigen::Matrix3d::Identity())) +
         matrixBlock("projection_matrix", 3, 4, yamlRowMajor(P));
}

}  // namespace omnister::detail
