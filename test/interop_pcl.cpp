// SPDX-License-Identifier: Apache-2.0
// Reads clouds as programs that use PCL do, and prints what it saw: one line a file.
#include <pcl/conversions.h>
#include <pcl/io/pcd_io.h>
#include <pcl/io/ply_io.h>
#include <pcl/point_cloud.h>
#include <pcl/point_types.h>

#include <cmath>
#include <cstdio>
#include <string>

int main(int argc, char** argv) {
  for (int i = 1; i < argc; ++i) {
    const std::string path = argv[i];
    pcl::PCLPointCloud2 raw;
    const bool ply = path.size() > 4 && path.substr(path.size() - 4) == ".ply";
    const int code = ply ? pcl::io::loadPLYFile(path, raw) : pcl::io::loadPCDFile(path, raw);
    if (code < 0) {
      std::fprintf(stderr, "PCL cannot read %s\n", path.c_str());
      return 1;
    }
    pcl::PointCloud<pcl::PointXYZRGB> cloud;
    pcl::fromPCLPointCloud2(raw, cloud);
    double x = 0, y = 0, z = 0, red = 0;
    std::size_t valid = 0;
    for (const pcl::PointXYZRGB& point : cloud) {
      if (!std::isfinite(point.x)) continue;
      ++valid;
      x += point.x;
      y += point.y;
      z += point.z;
      red += point.r;
    }
    const double n = valid > 0 ? static_cast<double>(valid) : 1.0;
    std::string fields;
    for (const auto& field : raw.fields) fields += (fields.empty() ? "" : ",") + field.name;
    std::printf("%zu %zu %.6f %.6f %.6f %.3f %s\n", cloud.size(), valid, x / n, y / n, z / n,
                red / n, fields.c_str());
  }
  return 0;
}
